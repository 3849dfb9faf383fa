"""Where the console may listen, and TLS: with real files, a real process and a real client."""

from __future__ import annotations

import json
import socket
import ssl
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from console.accounts import Role, account_line
from console.exposure import Exposure, StartError, check_local, is_local
from tests.codes import coded

PASSWORD = "hemlock and spruce"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with accounts, a self-signed certificate and its key, named as the service's credentials are."""
    folder = tmp_path_factory.mktemp("exposure")
    words = "req -x509 -newkey rsa:2048 -nodes -days 2 -subj /CN=timberhand -addext subjectAltName=IP:127.0.0.1"
    files = ("-keyout", folder / "console-key", "-out", folder / "console-cert")
    subprocess.run(
        ["openssl", *words.split(), *files],
        check=True,
        capture_output=True,
        timeout=60,
    )
    (folder / "console-passwords").write_text(account_line("anna", Role.OPERATOR, PASSWORD) + "\n")
    (folder / "console-passwords").chmod(0o600)
    return folder


def whole(folder: Path) -> Exposure:
    return Exposure(folder / "console-passwords", folder / "console-cert", folder / "console-key", folder / "audit")


@pytest.mark.parametrize("bind", ["127.0.0.1", "127.8.0.1", "::1", "localhost"])
def test_this_machine_alone_needs_nothing(bind: str) -> None:
    assert is_local(bind) and Exposure().check(bind) is None
    check_local(bind, "a recording")


@pytest.mark.parametrize("bind", ["0.0.0.0", "::", "192.168.7.2", "forwarder"])
def test_elsewhere_everything_is_needed(files: Path, bind: str) -> None:
    accounts = whole(files).check(bind)
    assert accounts is not None and accounts.names == ["anna"]
    for name in ("passwords", "tls_cert", "audit"):
        told = {n: getattr(whole(files), n) for n in Exposure.__slots__} | {name: None}
        told |= {"tls_key": None} if name == "tls_cert" else {}
        with pytest.raises(StartError, check=coded("console.unprotected")):
            Exposure(**told).check(bind)
    with pytest.raises(StartError, check=coded("console.local-only")):
        check_local(bind, "a recording")


def test_files_that_do_not_fit_are_refused(files: Path) -> None:
    good = whole(files)
    cases = {
        "console.tls-pair": Exposure(tls_cert=good.tls_cert),
        "console.tls-files": Exposure(tls_cert=good.tls_cert, tls_key=good.passwords),
        "accounts.unreadable": Exposure(passwords=files / "none"),
    }
    for code, exposure in cases.items():
        with pytest.raises(StartError, check=coded(code)):
            exposure.check("127.0.0.1")


def test_the_service_s_credentials_are_used_unless_options_are_given(files: Path, tmp_path: Path) -> None:
    found = Exposure().with_credentials({"CREDENTIALS_DIRECTORY": str(files)})
    assert (found.passwords, found.tls_cert, found.tls_key) == (
        files / "console-passwords",
        files / "console-cert",
        files / "console-key",
    )
    given = Exposure(passwords=tmp_path).with_credentials({"CREDENTIALS_DIRECTORY": str(files)})
    assert given.passwords == tmp_path
    assert Exposure().with_credentials({"CREDENTIALS_DIRECTORY": str(tmp_path)}) == Exposure()
    assert Exposure().with_credentials({}) == Exposure()


def console(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "console", "--port", "0", "--report-port", "0", *map(str, arguments)]


def test_the_process_refuses_with_one_sentence() -> None:
    done = subprocess.run(console("--bind", "0.0.0.0"), capture_output=True, text=True, timeout=30)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--passwords" in done.stderr and done.stdout == ""
    done = subprocess.run(console("--audit", "/none/audit"), capture_output=True, text=True, timeout=30)
    assert done.returncode == 3 and done.stderr.count("\n") == 1 and "/none/audit" in done.stderr


def test_a_person_signs_in_over_tls_from_an_address_of_the_network(files: Path, tmp_path: Path) -> None:
    e, audit = whole(files), tmp_path / "audit.jsonl"
    arguments = (
        "--bind",
        "0.0.0.0",
        "--passwords",
        e.passwords,
        "--tls-cert",
        e.tls_cert,
        "--tls-key",
        e.tls_key,
        "--audit",
        audit,
    )
    process = subprocess.Popen(console(*arguments), stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        url = json.loads(process.stdout.readline())["url"].replace("0.0.0.0", "127.0.0.1")
        assert url.startswith("https://")
        trusted = ssl.create_default_context(cafile=str(files / "console-cert"))
        body = json.dumps({"name": "anna", "password": PASSWORD}).encode()
        request = urllib.request.Request(f"{url}api/sign-in", data=body, method="POST")
        with urllib.request.urlopen(request, context=trusted, timeout=20) as answer:
            cookie = answer.headers["set-cookie"]
            assert answer.status == 204 and "Secure" in cookie and "HttpOnly" in cookie
        request = urllib.request.Request(
            f"{url}api/session", data=b"", method="POST", headers={"cookie": cookie.split(";")[0]}
        )
        with urllib.request.urlopen(request, context=trusted, timeout=20) as answer:
            assert json.load(answer)["role"] == "operator"
        port = int(url.split(":")[2].strip("/"))
        with socket.create_connection(("127.0.0.1", port), 5) as plain:
            plain.sendall(b"GET /api/state HTTP/1.1\r\nhost: 127.0.0.1\r\n\r\n")
            plain.settimeout(5)
            assert b"200" not in plain.recv(100), "nothing is served without TLS"
    finally:
        process.terminate()
        assert process.wait(10) == 0
    assert json.loads(audit.read_text().splitlines()[0])["who"] == "anna"
