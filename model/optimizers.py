"""The optimizers of a run: which rate applies to which part of the networks.

In: the networks and their `Optimization`. Out: one optimizer for encoder and classifier, one for
the discriminator where there is one.
"""

from typing import Any

from torch import nn
from torch.optim import SGD, Adam, AdamW, Optimizer

from model.config import Optimization
from model.losses.objective import Objective
from model.pvda import ViewDiscriminator
from model.two_views import EncoderWithClassifier


def build_optimizers(
    model: EncoderWithClassifier,
    objective: Objective,
    discriminator: ViewDiscriminator | None,
    config: Optimization,
) -> list[Optimizer]:
    """`start` of a parameter group is its initial learning rate. Frozen weights are in none."""

    def group(name: str, module: nn.Module, rate: float) -> dict[str, Any]:
        trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
        return {"params": trained, "start": rate, "name": name}

    groups = [
        group("backbone", model.encoder.backbone, config.backbone_lr),
        group("head", nn.ModuleList([model.encoder.pooling, model.encoder.refine]), config.head_lr),
        group("classifier", model.classifier, config.classifier_lr),
    ]
    if objective.learns:
        groups.append(group("objective", objective, config.head_lr))
    optimizers: list[Optimizer] = [
        SGD(
            groups, lr=0.0, momentum=config.momentum, nesterov=True,
            weight_decay=config.weight_decay,
        )
        if config.optimizer == "sgd"
        else AdamW(groups, lr=0.0, weight_decay=config.weight_decay)
    ]  # fmt: skip
    if discriminator is not None:
        rate = config.discriminator_lr
        optimizers.append(Adam([group("discriminator", discriminator, rate)], lr=0.0))
    return optimizers
