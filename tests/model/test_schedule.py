"""Alpha and the learning rates at the epochs that the paper names, and the shapes that it does not
have.
"""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.schedule import Schedule, ScheduleState, schedule_at

PAPER = Schedule()


@pytest.mark.parametrize(
    ("epoch", "alpha"),
    [(0, 0.9), (139, 0.9), (140, 1.0), (279, 1.0), (280, 1.1), (419, 1.1), (420, 1.2), (559, 1.2)],
)
def test_schedule_alpha_grows_every_140_epochs(epoch: int, alpha: float) -> None:
    assert schedule_at(PAPER, epoch).alpha == alpha


@pytest.mark.parametrize("start", [0, 140, 280, 420])
def test_schedule_rates_fall_and_restart_each_period(
    start: int,
) -> None:
    scales = [schedule_at(PAPER, start + within).lr_scale for within in (0, 59, 60, 119, 120, 139)]
    assert scales == pytest.approx([1, 1, 0.8, 0.8, 0.64, 0.64])


def test_schedule_ends_with_the_fourth_alpha() -> None:
    assert PAPER.epochs == 560


def test_schedule_without_restarts_only_lowers_rates() -> None:
    ablation = Schedule(restart=False, decay_epochs=(140, 280, 420))
    found = [schedule_at(ablation, epoch) for epoch in (0, 139, 140, 279, 280, 419, 420, 559)]
    assert [now.lr_scale for now in found] == pytest.approx(
        [1, 1, 0.8, 0.8, 0.64, 0.64, 0.512, 0.512]
    )
    assert [now.alpha for now in found] == [0.9, 0.9, 1.0, 1.0, 1.1, 1.1, 1.2, 1.2]


def test_schedule_constant_alpha_keeps_the_restarts() -> None:
    ablation = Schedule(alpha_step=0.0)
    assert [schedule_at(ablation, epoch) for epoch in (0, 60, 140, 200, 420)] == [
        ScheduleState(alpha=0.9, lr_scale=scale) for scale in (1.0, 0.8, 1.0, 0.8, 1.0)
    ]


def test_schedule_without_adversary_keeps_the_rates() -> None:
    control = Schedule(alpha=0.0, alpha_step=0.0)
    for epoch in range(0, 560, 7):
        assert schedule_at(control, epoch) == ScheduleState(
            alpha=0.0, lr_scale=schedule_at(PAPER, epoch).lr_scale
        )


def test_schedule_of_the_paper_is_constant_within_epochs() -> None:
    assert schedule_at(PAPER, 59.99) == schedule_at(PAPER, 59)
    assert schedule_at(PAPER, 139.99) == schedule_at(PAPER, 139)


def test_schedule_cosine_falls_from_one_to_zero() -> None:
    cosine = Schedule(epochs=80, lr_schedule="cosine")
    scales = [schedule_at(cosine, epoch).lr_scale for epoch in (0, 20, 40, 60, 80)]
    assert scales == pytest.approx([1, (1 + 0.5**0.5) / 2, 0.5, (1 - 0.5**0.5) / 2, 0])


def test_schedule_warm_up_grows_by_steps() -> None:
    warm, cold = Schedule(warmup_epochs=4), Schedule()
    assert [schedule_at(warm, epoch).lr_scale for epoch in (0, 1, 2.5, 4, 60)] == pytest.approx(
        [0, 0.25, 0.625, 1, 0.8]
    )
    cosine = Schedule(epochs=80, lr_schedule="cosine", warmup_epochs=4)
    assert schedule_at(cosine, 2).lr_scale == pytest.approx(
        schedule_at(Schedule(epochs=80, lr_schedule="cosine"), 2).lr_scale / 2
    )
    assert schedule_at(warm, 100) == schedule_at(cold, 100)


def test_schedule_cool_down_ends_at_zero() -> None:
    cooled = Schedule(epochs=300, cool_down_epochs=20)
    assert schedule_at(cooled, 279.5) == schedule_at(Schedule(epochs=300), 279.5)
    scales = [schedule_at(cooled, epoch).lr_scale for epoch in (280, 290, 300)]
    assert scales == pytest.approx([1, 0.5, 0])  # a period begins at 280
    assert cooled.scaled_to(30).cool_down_epochs == 2


@settings(max_examples=50)
@given(
    schedule=st.builds(
        Schedule,
        epochs=st.integers(1, 600),
        period=st.integers(1, 200),
        alpha=st.floats(0, 2),
        alpha_step=st.floats(0, 1),
        lr_schedule=st.sampled_from(["step", "cosine"]),
        restart=st.booleans(),
        warmup_epochs=st.floats(0, 10),
        cool_down_epochs=st.floats(0, 10),
    ),
    share=st.floats(0, 1),
)
def test_schedule_rates_and_alpha_stay_in_range(schedule: Schedule, share: float) -> None:
    now, later = (
        schedule_at(schedule, share * schedule.epochs),
        schedule_at(schedule, schedule.epochs),
    )
    assert 0 <= now.lr_scale <= 1
    assert now.alpha <= later.alpha
    assert now == schedule_at(schedule, share * schedule.epochs)


@pytest.mark.parametrize("wrong", [{"epochs": 0}, {"period": 0}, {"alpha": -0.1}])
def test_schedule_rejects_invalid_settings(
    wrong: dict[str, float],
) -> None:
    with pytest.raises(ValueError, match=str(next(iter(wrong.values()))).replace(".", r"\.")):
        Schedule(**wrong)  # type: ignore[arg-type]
