"""Signing keys: Ed25519. A robot keeps its private half in a file, the team file has everyone's public half."""

from __future__ import annotations

import os
from base64 import b64decode, b64encode
from binascii import Error as Base64Error
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from dgorl.errors import DgorlError

PUBLIC_BYTES = 32


class KeyFileError(DgorlError):
    """A key that cannot be made, read or used."""


class Signer(Protocol):
    """Signs for one robot."""

    @property
    def public(self) -> str | None:
        """The public half as it stands in the team file, base64; None where nothing is signed."""

    def sign(self, data: bytes) -> bytes:
        """The signature."""


class Key:
    """A robot's private key."""

    def __init__(self, private: Ed25519PrivateKey) -> None:
        self._private = private

    @property
    def public(self) -> str:
        """The public half, base64."""
        return b64encode(self._private.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)).decode()

    def sign(self, data: bytes) -> bytes:
        """Ed25519, 64 bytes."""
        return self._private.sign(data)


class _Unsigned:
    public = None

    def sign(self, data: bytes) -> bytes:
        return b""


UNSIGNED: Signer = _Unsigned()
"""For teams that say ``insecure: true``."""


class Roster:
    """Who belongs to the team and by which key they are known; in an insecure team by none."""

    def __init__(self, team: str, keys: Mapping[str, str | None], *, insecure: bool = False) -> None:
        """keys: robot → public half, base64. Raises KeyFileError for a key that is none or missing."""
        self.team = team
        self.insecure = insecure
        self.robots = tuple(sorted(keys))
        self._keys = {} if insecure else {robot: public_key(robot, key) for robot, key in keys.items()}

    def __contains__(self, robot: object) -> bool:
        return robot in self.robots

    def verify(self, robot: str, signature: bytes, data: bytes) -> bool:
        """Whether ``robot`` of this team signed ``data``; in an insecure team, whether it is not signed."""
        if self.insecure:
            return robot in self.robots and not signature
        key = self._keys.get(robot)
        if key is None:
            return False
        try:
            key.verify(signature, data)
        except InvalidSignature:
            return False
        return True


def public_key(robot: str, text: str | None) -> Ed25519PublicKey:
    """A public half from the team file. Raises KeyFileError."""
    try:
        raw = b64decode(text or "", validate=True)
    except (Base64Error, ValueError):
        raw = b""
    if len(raw) != PUBLIC_BYTES:
        what = "has no key" if text is None else "its key is not 32 bytes in base64"
        raise KeyFileError(f"robot `{robot}`: {what}; `dgorl keys --robot {robot} --out {robot}.key` makes one")
    return Ed25519PublicKey.from_public_bytes(raw)


def generate() -> Key:
    """A new key, in memory alone."""
    return Key(Ed25519PrivateKey.generate())


def make_key(path: Path) -> Key:
    """A new key in a new file only its owner can read (PEM, mode 0600). Raises KeyFileError if the file exists."""
    private = Ed25519PrivateKey.generate()
    text = private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(text)
    except FileExistsError:
        raise KeyFileError(f"{path}: exists; no key is overwritten: move it or name another file") from None
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be written: {error.strerror}") from error
    return Key(private)


def load_key(path: Path) -> Key:
    """The key in a file. Raises KeyFileError: not there, readable by others, not a private Ed25519 key."""
    try:
        mode = path.stat().st_mode
        text = path.read_bytes()
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}; `dgorl keys` makes a key") from error
    if os.name == "posix" and mode & 0o077:
        raise KeyFileError(f"{path}: others can read this key (mode {mode & 0o777:o}); `chmod 600 {path}`")
    try:
        private = load_pem_private_key(text, None)
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise KeyFileError(f"{path}: not a private key in PEM without a password") from error
    if not isinstance(private, Ed25519PrivateKey):
        raise KeyFileError(f"{path}: not an Ed25519 key; `dgorl keys` makes one")
    return Key(private)
