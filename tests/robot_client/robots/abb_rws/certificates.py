"""A certificate as a controller of RobotWare 7 presents it: self-signed, for an unused name."""

import shutil
import subprocess
from pathlib import Path

import pytest


def self_made(folder: Path, name: str = "controller") -> tuple[str, str]:
    """Files of a certificate and its key; skips the test where there is no openssl command."""
    if shutil.which("openssl") is None:
        pytest.skip("no openssl command to make a certificate with")
    cert, key = folder / f"{name}.pem", folder / f"{name}.key"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    command += ["-keyout", str(key), "-out", str(cert), "-days", "2", "-subj", f"/CN={name}"]
    subprocess.run(command, check=True, capture_output=True)
    return str(cert), str(key)
