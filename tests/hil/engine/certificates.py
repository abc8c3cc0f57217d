"""Certificates for TLS, made by openssl."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Certificates:
    """An authority, and a machine's certificate that it has signed."""

    ca: Path
    cert: Path
    key: Path

    @property
    def options(self) -> list[object]:
        """As `gough sweep` takes them."""
        return ["--tls-ca", self.ca, "--tls-cert", self.cert, "--tls-key", self.key]

    @property
    def dask_options(self) -> list[object]:
        """As `dask worker` takes them."""
        return ["--tls-ca-file", self.ca, "--tls-cert", self.cert, "--tls-key", self.key]


def make_certificates(folder: Path) -> Certificates:
    """A new authority and certificate in a folder."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder.mkdir()
    new = ["openssl", "req", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    sign = ["openssl", "x509", "-req", "-in", "machine.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial"]
    for command in (
        [*new, "-x509", "-keyout", "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=authority"],
        [*new, "-keyout", "machine.key", "-out", "machine.csr", "-subj", "/CN=machine"],
        [*sign, "-out", "machine.pem", "-days", "2"],
    ):
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return Certificates(folder / "ca.pem", folder / "machine.pem", folder / "machine.key")
