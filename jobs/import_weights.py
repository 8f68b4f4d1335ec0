"""Import public weights as a checkpoint: `import_weights.py (--torchvision | --lpn | --fsra |
--sample4geo | --mccg | --qdfl) FILE --out FILE`

Takes a torchvision ResNet's state dict, or that of the public code of LPN, FSRA, Sample4Geo, MCCG
or QDFL. The backbone, its size, the parts and the numbers per part are read off the file.
jobs/embed_gallery.py takes the checkpoint.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import ImportWeightsSettings


def main(settings: ImportWeightsSettings) -> None:
    """Import the weights of torchvision's ResNet or a method's public code into a checkpoint."""
    from jobs.stages.import_weights import import_weights

    import_weights(settings)


if __name__ == "__main__":
    run(main)
