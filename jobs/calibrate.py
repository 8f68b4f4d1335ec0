"""Calibrate the probabilities of an index's answers: `calibrate.py --checkpoint FILE --shards DIR
--index INDEX`

Writes INDEX/calibration.json, which locate.py and serve.py read from there, and the reliability
diagram beside it.
"""

from jobs.command_line.cli import run
from jobs.stages.settings import CalibrateSettings


def main(settings: CalibrateSettings) -> None:
    """Calibrate an index's answers on photos of locations that the encoder was not trained on."""
    from jobs.stages.calibrate import calibrate_index

    calibrate_index(settings)


if __name__ == "__main__":
    run(main)
