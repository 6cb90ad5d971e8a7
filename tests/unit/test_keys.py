"""Keys: private files, public halves, what a roster believes."""

from __future__ import annotations

import os
import stat
from base64 import b64decode
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.rsa import generate_private_key
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)

from dgorl.team.keys import UNSIGNED, KeyFileError, Roster, generate, load_key, make_key


def test_a_key_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "r1.key"
    key = make_key(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_key(path).public == key.public
    assert load_key(path).sign(b"x") == key.sign(b"x")
    assert len(b64decode(key.public)) == 32
    text = path.read_bytes()
    with pytest.raises(KeyFileError, match="exists"):
        make_key(path)
    assert path.read_bytes() == text


def test_a_key_is_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        make_key(tmp_path / "r1.key")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "r1.key").stat().st_mode) == 0o600


def test_no_key_goes_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(KeyFileError, match="exists"):
        make_key(tmp_path / "link")
    assert not (tmp_path / "elsewhere").exists()


def test_keys_others_can_read_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r1.key"
    make_key(path)
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        load_key(path)


@pytest.mark.parametrize("kind", ["missing", "folder", "text", "rsa", "password"])
def test_what_is_no_key_is_refused(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "k"
    private = load_pem_private_key(_pem(tmp_path), None)
    rsa = generate_private_key(65537, 2048)
    if kind == "folder":
        path.mkdir(mode=0o700)
    elif kind == "text":
        path.write_text("hello")
    elif kind == "rsa":
        path.write_bytes(rsa.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    elif kind == "password":
        path.write_bytes(private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"x")))
    if path.is_file():
        path.chmod(0o600)
    with pytest.raises(KeyFileError, match=str(path)):
        load_key(path)


def _pem(folder: Path) -> bytes:
    make_key(folder / "other.key")
    return (folder / "other.key").read_bytes()


def test_a_roster_believes_its_members_alone() -> None:
    a, b, stranger = generate(), generate(), generate()
    roster = Roster("t", {"a": a.public, "b": b.public})
    assert roster.robots == ("a", "b")
    assert "a" in roster
    assert "c" not in roster
    assert roster.verify("a", a.sign(b"x"), b"x")
    for robot, signature, data in (
        ("a", b.sign(b"x"), b"x"), ("a", stranger.sign(b"x"), b"x"), ("a", a.sign(b"x"), b"y"),
        ("a", b"", b"x"), ("a", bytes(64), b"x"), ("a", bytes(63), b"x"), ("c", stranger.sign(b"x"), b"x"),
    ):  # fmt: skip
        assert not roster.verify(robot, signature, data)


def test_an_insecure_roster_believes_what_is_not_signed() -> None:
    roster = Roster("t", {"a": None}, insecure=True)
    assert roster.verify("a", UNSIGNED.sign(b"x"), b"x")
    assert not roster.verify("a", generate().sign(b"x"), b"x")
    assert not roster.verify("c", b"", b"x")


@pytest.mark.parametrize("text", [None, "", "x", "AAAA", "é", "A" * 44, "A" * 64])
def test_what_is_no_public_half_is_refused(text: str | None) -> None:
    with pytest.raises(KeyFileError, match="robot `a`"):
        Roster("t", {"a": text})
