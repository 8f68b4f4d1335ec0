"""Keys are safe in a tar, stable, and different for different images."""

from hypothesis import given
from hypothesis import strategies as st

from pipeline.core.records import ImageRecord, Split, View, make_key

names = st.text(
    st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=20
)


def test_key_holds_split_view_location_and_file_name() -> None:
    record = ImageRecord(
        path="s3://b/x/image-01.jpeg", split=Split.TRAIN, view=View.DRONE, location="0839"
    )
    assert record.key == "train-drone-0839-image-01"


@given(names, names)
def test_keys_are_safe_and_differ_by_name(first: str, second: str) -> None:
    keys = [make_key(Split.QUERY, View.SATELLITE, "l", name) for name in (first, second)]
    assert all(set(key) <= set("abcdefghijklmnopqrstuvwxyz0123456789_-") for key in keys)
    assert (keys[0] == keys[1]) == (first == second)


def test_keys_differ_by_variant() -> None:
    records = [
        ImageRecord(
            path="a/0.jpg", split=Split.QUERY, view=View.DRONE, location="0008", variant=variant
        )
        for variant in ("", "150", "300")
    ]
    assert [record.key for record in records] == [
        "query-drone-0008-0",
        "query-drone-0008-150-0",
        "query-drone-0008-300-0",
    ]
