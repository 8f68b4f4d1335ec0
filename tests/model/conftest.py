"""Small networks of transformers, for the tests of their backbones and of their weights."""

import pytest

from tests.model.small_transformers import SMALL, use_small


@pytest.fixture(params=SMALL)
def small(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each class once, by a name that stands for a small network in this test."""
    return use_small(request.param, monkeypatch)


@pytest.fixture
def small_vit(monkeypatch: pytest.MonkeyPatch) -> str:
    return use_small("vit_small", monkeypatch)
