"""The two-step update of PVDA, and the state that a checkpoint stores. Knows no Ray and no files.

In: a batch of each view. Out: changed weights, and the metrics of the step, which stay on the
device. Shapes: B images of a view, H x W pixels or cells, C channels of the maps, P rings, L
locations.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_value_, get_total_norm

from model.config import LossWeights, Optimization, Precision, PVDAConfig
from model.losses.objective import Objective, by_view
from model.losses.pvda import adversarial_terms, feature_loss, view_terms
from model.optimizers import build_optimizers
from model.pvda import ViewDiscriminator
from model.schedule import ScheduleState
from model.two_views import EncoderWithClassifier

Module = TypeVar("Module", bound=nn.Module)


class Training:
    """Networks and optimizers of one run, and the iteration that updates them.

    `wrap_ddp` wraps each trained module (DDP over several workers); `adversary=False` leaves the
    discriminator out, which is LPN. With `sync_bn` BatchNorm's statistics are those of all workers'
    images, with `joint_bn` the encoder's are those of both views. In `bfloat16` the networks'
    products are computed under autocast, and weights, losses and updates stay float32; `auto` does
    this on CUDA. With `compile_for` images of each view a step the networks are compiled;
    `compile_error` has the reason where they are not.
    """

    def __init__(
        self,
        config: PVDAConfig,
        optimization: Optimization,
        locations: int,
        *,
        losses: LossWeights | None = None,
        adversary: bool = True,
        device: torch.device | str = "cpu",
        precision: Precision = "float32",
        sync_bn: bool = False,
        joint_bn: bool = False,
        compile_for: int | None = None,
        wrap_ddp: Callable[[nn.Module], nn.Module] = lambda module: module,
    ) -> None:
        self.device = torch.device(device)
        self.bfloat16 = precision == "bfloat16" or (
            precision == "auto" and self.device.type == "cuda"
        )
        self.model = _to_device(
            EncoderWithClassifier(config, locations, joint_bn), self.device, sync_bn
        )
        backbone = self.model.encoder.backbone
        self.objective = _to_device(
            Objective(
                losses or LossWeights(), config, backbone.channels, backbone.stride, locations
            ),
            self.device,
            sync_bn,
        )
        self.discriminator: ViewDiscriminator | None = None
        if adversary:
            discriminator = ViewDiscriminator(config, backbone.channels)
            self.discriminator = _to_device(discriminator, self.device, sync_bn)
        for module in self.modules.values():
            module.train()
        backbone.freeze(optimization.frozen_stages)
        self.compile_error = (
            None if compile_for is None else self._compile(config.image_size, compile_for)
        )
        "Why the networks are not compiled though compilation was requested."
        self._wrapped = wrap_ddp(self.model)
        self._discriminator = None if self.discriminator is None else wrap_ddp(self.discriminator)
        self._objective = wrap_ddp(self.objective) if self.objective.learns else self.objective
        self.clip_value = optimization.clip_value
        self._fitted = [*self.model.parameters(), *self.objective.parameters()]
        self.optimizers = build_optimizers(
            self.model, self.objective, self.discriminator, optimization
        )

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The networks by their names in a checkpoint."""
        named: dict[str, nn.Module] = {
            "encoder": self.model.encoder,
            "classifier": self.model.classifier,
        }
        if self.objective.learns:
            named["objective"] = self.objective
        if self.discriminator is not None:
            named["discriminator"] = self.discriminator
        return named

    @property
    def learning_rates(self) -> dict[str, float]:
        """Learning rates in force, by group."""
        return {
            group["name"]: group["lr"]
            for optimizer in self.optimizers
            for group in optimizer.param_groups
        }

    def step(
        self,
        images1_B3HW: Tensor,
        location1_B: Tensor,
        images2_B3HW: Tensor,
        location2_B: Tensor,
        schedule: ScheduleState,
    ) -> dict[str, Tensor]:
        """One iteration: D takes a step on Eq. 2, then encoder and classifier one on Eq. 4, where
        the recipe's objective stands for Eq. 1. Where its losses compare the views row by row, row
        i of both is one location.

        One encoder pass serves both steps; D gets both views in one batch, since BatchNorm over
        separate batches would erase the shift between the views that D learns from. Returns the
        step's metrics, detached scalars that are still on the device: each loss, in total and by
        view (and ring), the accuracy of D, and the norm of each network's gradient.
        """
        for optimizer in self.optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["start"] * schedule.lr_scale
        with self._autocast():
            drone, satellite = self._wrapped(images1_B3HW, images2_B3HW)
        total, metrics = self._objective(drone, location1_B, satellite, location2_B)
        if self.discriminator is not None:
            both_BCHW = torch.cat([drone.maps_BCHW, satellite.maps_BCHW])
            metrics |= self.discriminate(both_BCHW.detach(), len(drone.maps_BCHW))
            # D's weights are constants of the second step; its BatchNorm stays in training mode.
            self.discriminator.requires_grad_(False)
            with self._autocast():
                verdict_B2 = self.discriminator(both_BCHW)
            self.discriminator.requires_grad_(True)
            adversarial_V = adversarial_terms(*verdict_B2.tensor_split([len(drone.maps_BCHW)]))
            adversarial = adversarial_V.sum()
            total = feature_loss(total, adversarial, schedule.alpha)
            metrics |= {"adversarial_loss": adversarial} | by_view(
                "adversarial_loss", adversarial_V
            )
        self.optimizers[0].zero_grad(set_to_none=True)
        total.backward()
        for name, module in (
            ("encoder", self.model.encoder),
            ("classifier", self.model.classifier),
        ):
            metrics[f"gradient_norm/{name}"] = gradient_norm(module)
        if self.clip_value:
            clip_grad_value_(self._fitted, self.clip_value)
        self.optimizers[0].step()
        return {name: metric.detach() for name, metric in metrics.items()}

    def discriminate(self, both_BCHW: Tensor, drones: int) -> dict[str, Tensor]:
        """Step 1: train D to tell the views apart; the first `drones` maps are the UAV's."""
        assert self._discriminator is not None
        with self._autocast():
            verdict_B2 = self._discriminator(both_BCHW)
        verdicts = verdict_B2.tensor_split([drones])
        terms_V = view_terms(*verdicts)
        loss = terms_V.sum()
        self.optimizers[1].zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = gradient_norm(self._discriminator)
        self.optimizers[1].step()
        right_V = [
            (verdict_B2.argmax(1) == view).float() for view, verdict_B2 in enumerate(verdicts)
        ]
        return (
            {"view_loss": loss, "discriminator_accuracy": torch.cat(right_V).mean()}
            | {"gradient_norm/discriminator": norm}
            | by_view("view_loss", terms_V)
            | by_view(
                "discriminator_accuracy", torch.stack([right_B.mean() for right_B in right_V])
            )
        )

    def _compile(self, size: int, count: int) -> str | None:
        """Compile the networks in place and run them once: torch compiles at the first call.
        Returns the reason where it cannot.
        """
        networks = [self.model] + ([self.discriminator] if self.discriminator is not None else [])
        states = [
            {name: tensor.clone() for name, tensor in network.state_dict().items()}
            for network in networks
        ]
        images_B3HW = torch.zeros(count, 3, size, size, dtype=torch.uint8, device=self.device)
        images_B3HW = images_B3HW.to(memory_format=torch.channels_last)
        try:
            for network in networks:
                network.compile()
            with self._autocast():
                views = self.model(images_B3HW, images_B3HW)
                logits = [view.logits_BPL for view in views]
                if self.discriminator is not None:
                    maps_BCHW = torch.cat([view.maps_BCHW for view in views])
                    logits.append(self.discriminator(maps_BCHW))
            sum(one.float().mean() for one in logits).backward()
        except Exception as error:  # the compiler's own kinds, the C++ compiler's, the driver's
            for network in networks:
                network._compiled_call_impl = None  # torch has no public way back
            reason = "".join(str(error).strip().splitlines()[:1])
            return f"{type(error).__name__}: {reason}"
        finally:  # the trial changed BatchNorm's statistics
            for network, state in zip(networks, states, strict=True):
                network.load_state_dict(state)
                network.zero_grad(set_to_none=True)
        return None

    def _autocast(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step depends on, besides the order of the data, as tensors and
        plain values.
        """
        return {
            "modules": {name: module.state_dict() for name, module in self.modules.items()},
            "optimizers": [optimizer.state_dict() for optimizer in self.optimizers],
            "rng": torch.get_rng_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume where `state` was taken."""
        for name, module in self.modules.items():
            module.load_state_dict(state["modules"][name])
        for optimizer, saved in zip(self.optimizers, state["optimizers"], strict=True):
            optimizer.load_state_dict(saved)
        torch.set_rng_state(state["rng"])


def gradient_norm(module: nn.Module) -> Tensor:
    """Norm of a network's gradient, all its parameters taken as one vector."""
    return get_total_norm(
        [parameter.grad for parameter in module.parameters() if parameter.grad is not None]
    )


def _to_device(module: Module, device: torch.device, sync_bn: bool) -> Module:
    if sync_bn:
        module = nn.SyncBatchNorm.convert_sync_batchnorm(module)  # type: ignore[no-untyped-call]
    placed: Module = module.to(  # type: ignore[call-overload]
        device, memory_format=torch.channels_last
    )
    return placed
