"""Certificates for mutual TLS, made on the spot: an authority and one certificate a robot."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID


def make(folder: Path, robots: tuple[str, ...], authority: str = "ca") -> None:
    """FOLDER/AUTHORITY.pem, and ROBOT.pem and ROBOT.key.pem of every robot, good for an hour on 127.0.0.1."""
    root_key = ec.generate_private_key(ec.SECP256R1())
    root = _certificate(f"{authority} of the team", root_key, None, None)
    _write(folder / f"{authority}.pem", root.public_bytes(serialization.Encoding.PEM))
    for robot in robots:
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _certificate(robot, key, root, root_key)
        _write(folder / f"{robot}.pem", certificate.public_bytes(serialization.Encoding.PEM))
        _write(
            folder / f"{robot}.key.pem",
            key.private_bytes(
                serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
            ),
        )


def _certificate(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    root: x509.Certificate | None,
    root_key: ec.EllipticCurvePrivateKey | None,
) -> x509.Certificate:
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    now = datetime.now(UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if root is None else root.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(minutes=5))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.BasicConstraints(ca=root is None, path_length=None), critical=True)
    )
    if root is not None:
        names = x509.SubjectAlternativeName([x509.IPAddress(ip_address("127.0.0.1")), x509.DNSName("localhost")])
        builder = builder.add_extension(names, critical=False)
    return builder.sign(root_key or key, hashes.SHA256())


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
