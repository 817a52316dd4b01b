"""Reads the files of certificates and keys, and says which of them is wrong: gRPC only says that something is."""

import ssl
from pathlib import Path

from sceneloom.errors import DataError
from sceneloom.formats.files import read_settings


def read_certificates(path: Path) -> bytes:
    """Read the certificates of a PEM file.

    Raises:
        DataError: there are none, or the file cannot be read.
    """
    content = read_settings(path)
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(cafile=path)
    except ssl.SSLError as error:
        raise DataError(path, "", "no certificate; expected a PEM file (BEGIN CERTIFICATE)") from error
    return content


def read_pair(certificate: Path, key: Path) -> tuple[bytes, bytes]:
    """Read a certificate and its key.

    Returns:
        the certificates and the key, as the PEM files have them.

    Raises:
        DataError: one of them is none or cannot be read, or they do not belong together.
    """
    certificates, private = read_certificates(certificate), read_settings(key)
    try:
        # a password of our own: without one OpenSSL would ask at the terminal
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "none")
    except ssl.SSLError as error:
        wanted = f"the unencrypted key (PEM) of the certificate in {certificate}"
        raise DataError(key, "", f"not that key; expected {wanted}") from error
    return certificates, private
