"""The token, the headers of all responses, and the settings that they depend on."""

from pathlib import Path
from typing import Any

import pytest

from pipeline.core.errors import InputError
from pipeline.service.settings import ServiceSettings
from tests.service.http_client import (
    TOKEN,
    Client,
    FakeEngine,
    error_sentence,
    post,
    run_with_service,
)
from tests.service.photos import photo


def test_token_is_required_except_for_public_paths() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for given in (
            "",
            "Bearer",
            "Bearer another-token-altogether",
            f"Basic {TOKEN}",
            f"Bearer {TOKEN}x",
            "Bearer ä",
        ):
            response = await post(client, photo(), **({"Authorization": given} if given else {}))
            assert response.headers["WWW-Authenticate"] == "Bearer"
            assert TOKEN not in await error_sentence(response, 401)
        assert (await client.get("/metrics")).status == 401
        assert (await post(client, photo(), Authorization=f"Bearer {TOKEN}")).status == 200
        for path in ("/", "/map.js", "/page.js", "/style.css", "/api", "/openapi.json", "/health"):
            assert (await client.get(path)).status == 200
        assert await (await client.get("/health")).json() == {"ready": True}
        assert (await client.get("/health", headers={"Host": "drones.example"})).status == 200
        trusted = await client.get("/health", headers={"Authorization": f"Bearer {TOKEN}"})
        assert (await trusted.json())["rows"] == 3

    run_with_service(test, token=TOKEN)


def test_security_headers_on_every_response() -> None:
    async def test(client: Client, engine: FakeEngine) -> None:
        for path in ("/", "/api", "/health", "/no-such-path"):
            headers = (await client.get(path)).headers
            assert headers["Content-Security-Policy"].startswith(
                "default-src 'none'; script-src 'self';"
            )
            assert "unsafe" not in headers["Content-Security-Policy"]
            assert headers["X-Content-Type-Options"] == "nosniff"
            assert headers["Server"] == "pvda"

    run_with_service(test)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"host": "0.0.0.0"}, "--token-file"),
        ({"port": 70_000}, "--port"),
        ({"batch": 0}, "--batch"),
        ({"waiting": 0}, "--waiting"),
        ({"timeout_s": float("nan")}, "--timeout-s"),
        ({"max_megabytes": 0.0}, "--max-meg"),
    ],
)
def test_settings_invalid_value_is_refused(settings: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError, match=word):
        ServiceSettings(**settings)


def test_token_is_first_line_and_long_enough(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\nand a remark\n")
    assert ServiceSettings(host="0.0.0.0", token_file=str(path)).token() == TOKEN
    assert ServiceSettings().token() is None
    for text in ("", "short", "with blanks between words", "ümläute-sind-nicht-ascii"):
        path.write_text(text)
        with pytest.raises(InputError, match="16"):
            ServiceSettings(token_file=str(path)).token()
    with pytest.raises(InputError, match="no file at"):
        ServiceSettings(token_file=str(tmp_path / "none")).token()
