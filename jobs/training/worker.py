"""One training worker, wherever it runs: the epochs that are left, with checkpoints and metrics
after each.

In: a run and this worker's context. Out: the run's folder, written by rank 0. `loop.py` has one
epoch, `rounds.py` the pseudo-labels of several, `state.py` what a worker holds between epochs.
"""

from contextlib import ExitStack, closing

from jobs.training.checkpoints import RunRecorder
from jobs.training.loop import train_epoch
from jobs.training.probes import probe
from jobs.training.rounds import start_round
from jobs.training.settings import RunConfig
from jobs.training.state import Report, TrainingState, WorkerContext


def train_worker(run: RunConfig, context: WorkerContext, report: Report) -> None:
    """Train to the end of the recipe's schedule, from the run's checkpoint where there is one.

    Raises Incomplete when training diverges; the last checkpoint is then from before.
    """
    state, epochs = TrainingState(run, context, report), run.recipe.schedule.epochs
    with ExitStack() as stack:
        recorder = None
        if context.rank == 0:
            recorder = stack.enter_context(closing(RunRecorder(run, state.found)))
        for epoch in range(len(state.history), epochs):
            labelled = start_round(state, epoch) if run.recipe.pseudo_neighbours else {}
            row = train_epoch(state, epoch, recorder) | labelled
            due = run.probe_epochs and ((epoch + 1) % run.probe_epochs == 0 or epoch + 1 == epochs)
            if recorder is not None and due:
                row |= probe(state.training.model.encoder, state.stream)
            state.end_epoch(row)
            if recorder is not None:
                recorder.after_epoch(state.checkpoint, state.history)
            context.after_epoch(row)
