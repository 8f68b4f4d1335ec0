"""What building the whole gallery is expected to take, from the times of a sample."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.index.planning.trial import KMEANS_ROUNDS, BuildTimes, expected_seconds

times = st.builds(
    BuildTimes,
    training=st.floats(0, 10),
    adding=st.floats(0, 10),
    comparing=st.floats(0, 10),
    learned=st.floats(0.1, 1),
)
factors = st.floats(1, 100)
SAMPLE = {"more_training": 1.0, "more_rows": 1.0, "more_lists": 1.0, "deeper": 1.0}


def test_expected_seconds_scale_only_comparisons_by_lists() -> None:
    """Lists: learning them is ten comparisons of 0.2 s, adding one; the rest grows by the rows."""
    of_lists = BuildTimes(training=2.5, adding=0.7, comparing=0.2, learned=1.0)
    more = {"more_training": 3.0, "more_rows": 100.0, "more_lists": 16.0, "deeper": 1.0}
    training = (KMEANS_ROUNDS * 0.2 * 16 + 0.5) * 3
    adding = (0.2 * 16 + 0.5) * 100
    assert expected_seconds(of_lists, **more) == pytest.approx(training + adding)


def test_expected_seconds_of_a_graph_grow_by_its_depth() -> None:
    graph = BuildTimes(training=0.1, adding=2.0, comparing=0.0, learned=1.0)
    more = {"more_training": 0.0, "more_rows": 30.0, "more_lists": 1.0, "deeper": 1.5}
    assert expected_seconds(graph, **more) == pytest.approx(2.0 * 1.5 * 30)


@given(times)
def test_expected_seconds_of_the_sample_are_its_own(sample: BuildTimes) -> None:
    everything = replace(sample, learned=1.0)
    found = expected_seconds(everything, **SAMPLE)
    assert found == pytest.approx(sample.training + sample.adding)


@given(times, factors, st.sampled_from(sorted(SAMPLE)))
def test_expected_seconds_never_fall_with_more_work(
    sample: BuildTimes, factor: float, name: str
) -> None:
    more = SAMPLE | {name: factor}
    assert expected_seconds(sample, **more) >= expected_seconds(sample, **SAMPLE) * (1 - 1e-9)
