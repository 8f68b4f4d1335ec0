"""The check of a flag: valid values pass, others are refused in one sentence."""

import pytest

from pipeline.core.errors import InputError, require


def test_require_passes_a_valid_value() -> None:
    require(True, "top", 5, "at least 1")


@pytest.mark.parametrize(
    ("flag", "value", "sentence"),
    [
        ("top", 0, "--top is 0, expected at least 1"),
        ("max_bad_fraction", 2.5, "--max-bad-fraction is 2.5, expected at least 1"),
        ("--train-flights", "x", "--train-flights is 'x', expected at least 1"),
    ],
)
def test_require_names_flag_value_and_expectation(flag: str, value: object, sentence: str) -> None:
    with pytest.raises(InputError) as refused:
        require(False, flag, value, "at least 1")
    assert str(refused.value) == sentence
