"""Ed25519 signatures (RFC 8032) of a file beside it, ``FILE.sig`` of 64 bytes, by the package cryptography.

Keys are PEM files (PKCS 8 and SubjectPublicKeyInfo), as openssl reads and writes them.  The private key stays with
those who make releases and never comes to a machine.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from host.exit_codes import CommandFailed

PRIVATE_NAME: Final = "signing-key.pem"
PUBLIC_NAME: Final = "signer.pem"


def signature_path(file: Path) -> Path:
    """Return where the signature of a file lies."""
    return file.with_name(f"{file.name}.sig")


def make_keys(folder: Path) -> tuple[Path, Path]:
    """Make a pair of keys in ``folder``: (private, public) file.

    Raises:
        CommandFailed: there is a key already, or the folder cannot be written.
    """
    private, public = folder / PRIVATE_NAME, folder / PUBLIC_NAME
    key = Ed25519PrivateKey.generate()
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open(os.open(private, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(secret)
        public.write_bytes(
            key.public_key().public_bytes(serialization.Encoding.PEM, serialization.PublicFormat.SubjectPublicKeyInfo)
        )
    except FileExistsError:
        raise CommandFailed(
            "signature.key-exists", f"{private} exists; a new key would be another signer: name another folder"
        ) from None
    except OSError as error:
        raise CommandFailed("signature.key-not-written", f"{folder} cannot take a key: {error.strerror}") from None
    return private, public


def sign(file: Path, private: Path) -> Path:
    """Sign a file with a private key; returns the path of the signature.

    Raises:
        CommandFailed: the key or the file cannot be used.
    """
    try:
        key = serialization.load_pem_private_key(private.read_bytes(), None)
    except (OSError, ValueError, TypeError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PrivateKey):
        raise CommandFailed(
            "signature.private-key",
            f"{private} is no readable private Ed25519 key without a password; make one: timberhand release keygen",
        )
    try:
        content = file.read_bytes()
    except OSError as error:
        sentence = f"{file} cannot be read: {error.strerror}; name the file to sign"
        raise CommandFailed("signature.unreadable", sentence) from None
    path = signature_path(file)
    try:
        path.write_bytes(key.sign(content))
    except OSError as error:
        raise CommandFailed("signature.not-written", f"{path} cannot be written: {error.strerror}") from None
    return path


def verify(file: Path, public: Path) -> None:
    """Check the signature beside a file.

    Raises:
        CommandFailed: the key is unusable, or the signature is missing or another one's.
    """
    try:
        key = serialization.load_pem_public_key(public.read_bytes())
    except (OSError, ValueError, UnsupportedAlgorithm):
        key = None
    if not isinstance(key, Ed25519PublicKey):
        raise CommandFailed(
            "signature.public-key",
            f"{public} is no readable public Ed25519 key; install the key of those who sign your releases there",
        )
    try:
        key.verify(signature_path(file).read_bytes(), file.read_bytes())
    except (OSError, InvalidSignature):
        raise CommandFailed(
            "signature.bad",
            f"the signature of {file} is not by {public}; nothing is used of it: get it again from its maker",
        ) from None
