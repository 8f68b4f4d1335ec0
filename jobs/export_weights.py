"""Export a checkpoint's encoder: `export_weights.py --checkpoint FILE --out FILE.safetensors`

The file has the encoder alone, its matrices in float16: a tenth of a checkpoint of training. Every
`--checkpoint` takes it, and train.py's --weights.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import ExportWeightsSettings


def main(settings: ExportWeightsSettings) -> None:
    """Export a checkpoint's encoder as a small .safetensors file."""
    from jobs.stages.export_weights import export_weights

    export_weights(settings)


if __name__ == "__main__":
    run(main)
