"""Keys of a network of hosts: a private certificate authority and one certificate for each host.

=====================  ===========================================================================================
``ca.pem``             the authority's certificate
``ca-key.pem``         its private key: it stays where it was made, whoever has it can make himself a host
``HOST/ca.pem``        what one host needs, and nothing else: this folder is copied to it
``HOST/cert.pem``      its certificate; the common name is the host's name in the graph
``HOST/key.pem``       its private key
=====================  ===========================================================================================
"""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from runner.contract import Refused
from runner.graph.placement import READER, Credentials, Host

T = TypeVar("T")
Extension = tuple[x509.ExtensionType, bool]
"""What a certificate says beside names and dates, and whether who does not understand it must refuse."""
Signed = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]

CA_DAYS = 3650
HOST_DAYS = 825
"""How long a host's certificate holds: `runner keys add` makes the next one."""
AUTHORITY = "runner network"


def make_keys(folder: Path, hosts: Sequence[Host]) -> None:
    """Makes an authority, and a certificate for each host and for who may only listen; raises Refused where the folder
    has keys already."""
    if (folder / "ca.pem").exists() or (folder / "ca-key.pem").exists():
        raise Refused(
            f"{folder}: there are keys already and they are not overwritten; "
            f"valid: another folder, or `runner keys add --keys {folder} NAME=ADDRESS` for one more host"
        )
    owners = [*hosts, Host(READER, "localhost")]
    _refuse_taken(folder, owners)
    authority = _sign(AUTHORITY, days=CA_DAYS, extensions=_AUTHORITY)
    _write(folder, {"ca.pem": _pem(authority), "ca-key.pem": _key_pem(authority)})
    _add(folder, authority, owners)


def add_keys(folder: Path, hosts: Sequence[Host]) -> None:
    """Makes certificates with the authority that is there; raises Refused where one would be overwritten."""
    authority = _read_certificate(folder / "ca.pem"), _read_key(folder / "ca-key.pem")
    _refuse_taken(folder, hosts)
    _add(folder, authority, hosts)


def credentials(folder: Path, host: str) -> Credentials:
    """The paths of a host's credentials, checked: they are there, belong together, hold today and are private."""
    own = folder / host
    certificate, key = _read_certificate(own / "cert.pem"), _read_key(own / "key.pem")
    _read_certificate(own / "ca.pem")
    name = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    if name != host:
        raise Refused(f"{own / 'cert.pem'}: is the certificate of {name!r}; valid: that of {host!r}")
    if certificate.not_valid_after_utc < datetime.datetime.now(datetime.UTC):
        day = certificate.not_valid_after_utc.date()
        raise Refused(f"{own / 'cert.pem'}: ended on {day}; remove {own} and make another: runner keys add")
    if certificate.public_key() != key.public_key():
        raise Refused(f"{own / 'key.pem'}: is not the key of the certificate beside it; copy the folder as a whole")
    if (own / "key.pem").stat().st_mode & 0o077:
        raise Refused(f"{own / 'key.pem'}: others on this machine can read it; type: chmod 600 {own / 'key.pem'}")
    return Credentials(*(str((own / file).absolute()) for file in ("ca.pem", "cert.pem", "key.pem")))


# ---------------------------------------------------------------------------------------------- certificates

_AUTHORITY: list[Extension] = [
    (x509.BasicConstraints(ca=True, path_length=0), True),
    (
        x509.KeyUsage(
            digital_signature=False,
            content_commitment=False,
            key_encipherment=False,
            data_encipherment=False,
            key_agreement=False,
            key_cert_sign=True,
            crl_sign=True,
            encipher_only=False,
            decipher_only=False,
        ),
        True,
    ),
]


def _sign(name: str, *, days: int, extensions: list[Extension], by: Signed | None = None) -> Signed:
    """A new key and its certificate, signed by an authority or by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    issuer, issuer_key = (_name(name), key) if by is None else (by[0].subject, by[1])
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        # Clocks of machines differ; a certificate must hold at once on all of them.
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=days))
    )
    for extension, critical in extensions:
        builder = builder.add_extension(extension, critical)
    return builder.sign(issuer_key, hashes.SHA256()), key


def _refuse_taken(folder: Path, hosts: Sequence[Host]) -> None:
    names = [host.name for host in hosts]
    for name in names:
        if (folder / name).exists():
            raise Refused(f"{folder / name}: is there already and is not overwritten; remove it to make another")
        if names.count(name) > 1:
            raise Refused(f"{name}: is named twice; valid: names that differ, and {READER} is who may only listen")


def _add(folder: Path, authority: Signed, hosts: Sequence[Host]) -> None:
    for host in hosts:
        signed = _sign(host.name, days=HOST_DAYS, extensions=_extensions(host), by=authority)
        _write(folder / host.name, {"ca.pem": _pem(authority), "cert.pem": _pem(signed), "key.pem": _key_pem(signed)})


def _extensions(host: Host) -> list[Extension]:
    """A host both calls and is called, so its certificate serves both sides of a link."""
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    names: list[x509.GeneralName] = [x509.DNSName(host.name)]
    with contextlib.suppress(ValueError):
        names.append(x509.IPAddress(ipaddress.ip_address(host.address)))
    if len(names) == 1 and host.address not in ("", host.name):
        names.append(x509.DNSName(host.address))
    return [
        (x509.BasicConstraints(ca=False, path_length=None), True),
        (usage, False),
        (x509.SubjectAlternativeName(names), False),
    ]


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


# ---------------------------------------------------------------------------------------------- files


def _pem(signed: Signed) -> bytes:
    return signed[0].public_bytes(serialization.Encoding.PEM)


def _key_pem(signed: Signed) -> bytes:
    return signed[1].private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    """New files that only their owner reads, from the first byte on, in a folder that only he enters."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, data in files.items():
            with os.fdopen(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                file.write(data)
    except OSError as error:
        raise Refused(f"{error.filename or folder}: {error.strerror}") from None


def _read_certificate(path: Path) -> x509.Certificate:
    return _read(path, x509.load_pem_x509_certificate, "certificate")


def _read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    key = _read(path, lambda data: serialization.load_pem_private_key(data, None), "private key")
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise Refused(f"{path}: is not a key that `runner keys` made")
    return key


def _read(path: Path, parse: Callable[[bytes], T], what: str) -> T:
    try:
        return parse(path.read_bytes())
    except OSError as error:
        name = path.parent.name
        hint = f"make keys with `runner keys init`, and copy the folder {name} to the machine that is {name}"
        raise Refused(f"{path}: {error.strerror}; {hint}") from None
    except (ValueError, TypeError):
        raise Refused(f"{path}: is no {what}") from None
