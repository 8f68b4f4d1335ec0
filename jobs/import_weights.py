"""Import public weights as a checkpoint: `import_weights.py (--torchvision FILE | --lpn FILE) --out
FILE`

Takes a torchvision ResNet's state dict, or that of a three_view_net of the public LPN code. The
backbone, its width, the rings and the numbers per ring are read off the file.
jobs/embed_gallery.py takes the checkpoint.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import ImportWeightsSettings


def main(settings: ImportWeightsSettings) -> None:
    """Import the weights of torchvision's ResNet or of LPN into a checkpoint."""
    from jobs.stages.import_weights import import_weights

    import_weights(settings)


if __name__ == "__main__":
    run(main)
