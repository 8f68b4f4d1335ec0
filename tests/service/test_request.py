"""Validation of requests: rough positions, numbers of candidates, and photos without decoding."""

import pytest

from pipeline.core.geo import Circle
from pipeline.matching.photo_pose import PoseSettings
from pipeline.service.request import MAX_SCANS, RequestError, parse_request
from tests.service.photos import bomb, photo

MEGAPIXELS = 1_000_000


def refused(photo: bytes, **fields: str) -> RequestError:
    with pytest.raises(RequestError) as caught:
        parse_request(photo, fields, MEGAPIXELS)
    return caught.value


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP"])
def test_request_photo_alone(form: str) -> None:
    request = parse_request(photo(form), {}, MEGAPIXELS)
    assert (request.near, request.top) == (None, 5)


def test_request_rough_position() -> None:
    request = parse_request(
        photo(), {"lat": "47.5", "lon": "-8", "radius_m": "2e3", "top": "3"}, MEGAPIXELS
    )
    assert request.near == Circle(lat=47.5, lon=-8.0, radius_m=2000.0)
    assert request.top == 3


@pytest.mark.parametrize(
    "lat", ["NaN", "inf", "-Infinity", "1e999", "north", "47,5", "91", "1" * 400]
)
def test_request_invalid_latitude_is_refused(lat: str) -> None:
    refusal = refused(photo(), lat=lat, lon="8", radius_m="100")
    assert refusal.status == 400
    assert "expected" in refusal.sentence
    assert len(refusal.sentence) < 300


@pytest.mark.parametrize(("lon", "radius"), [("181", "5"), ("8", "0"), ("8", "-1"), ("8", "nan")])
def test_request_invalid_circle_is_refused(lon: str, radius: str) -> None:
    assert refused(photo(), lat="1", lon=lon, radius_m=radius).status == 400


def test_request_incomplete_position_is_refused() -> None:
    assert "found only lat and lon" in refused(photo(), lat="1", lon="2").sentence


def test_request_camera_fields() -> None:
    fields = {"fov": "73.7", "height": "80", "heading": "12.5", "pitch": "-60"}
    request = parse_request(photo(), fields, MEGAPIXELS)
    assert request.pose == PoseSettings(fov=73.7, height=80.0, heading=12.5, pitch=-60.0)
    assert parse_request(photo(), {"fov": " "}, MEGAPIXELS).pose == PoseSettings()


@pytest.mark.parametrize(
    ("name", "text"),
    [("fov", "0"), ("fov", "wide"), ("height", "-3"), ("heading", "900"), ("pitch", "10")],
)
def test_request_invalid_camera_field_is_refused(name: str, text: str) -> None:
    refusal = refused(photo(), **{name: text})
    assert refusal.status == 400
    assert refusal.sentence.startswith(f"{name} is ")
    assert "expected" in refusal.sentence


@pytest.mark.parametrize("top", ["0", "51", "-1", "2.5", "all", "9" * 50, "٣"])
def test_request_invalid_top_is_refused(top: str) -> None:
    assert refused(photo(), top=top).status == 400


@pytest.mark.parametrize(
    ("data", "status", "word"),
    [
        (b"", 400, "empty"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 415, "expected a JPEG"),
        (b"GIF89a" + bytes(60), 415, "expected a JPEG"),
        (b"%!PS-Adobe-3.0 EPSF-3.0", 415, "expected a JPEG"),
        (b"RIFF\x00\x00\x00\x00WAVE", 415, "expected a JPEG"),
        (photo()[:-2], 422, "truncated"),
        (photo()[:20], 422, "truncated"),
        (photo("PNG")[:60], 422, "truncated"),
        (photo(size=(900, 4)), 422, "absurd dimensions"),
        (photo(size=(1001, 1000)), 413, "1001 x 1000"),
        (photo("WEBP", size=(1001, 1000)), 413, "1001 x 1000"),
        (bomb(1100), 413, "1100 x 1100"),
    ],
)  # fmt: skip
def test_request_unusable_photo_is_refused(data: bytes, status: int, word: str) -> None:
    refusal = refused(data)
    assert refusal.status == status
    assert word in refusal.sentence


def test_request_large_cmyk_photo_is_not_decoded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_decoding(data: bytes) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr("pipeline.images.inspect.decode", no_decoding)
    assert refused(photo(mode="CMYK", size=(1001, 1000))).status == 413


def test_request_jpeg_of_many_scans_is_refused() -> None:
    data = photo()
    scan = b"\xff\xda\x00\x0c"
    assert parse_request(data[:-2] + scan * (MAX_SCANS - 1) + data[-2:], {}, MEGAPIXELS)
    assert "scans" in refused(data[:-2] + scan * MAX_SCANS + data[-2:]).sentence
