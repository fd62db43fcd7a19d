"""Lets the tests of policies import what they share, and makes a certificate for them."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
MAKE = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -days 2 -subj /CN=localhost"
"""Command that makes a certificate and its key."""


@pytest.fixture(scope="module")
def narrow_resnet():
    """Vision encoders of checkpoints are narrow."""
    from checkpoints.made_checkpoints import install

    with pytest.MonkeyPatch.context() as patch:
        install(patch)
        yield


@pytest.fixture(scope="session")
def make_certificate():
    """Makes a certificate that nobody vouches for, and its key, in a folder."""
    if shutil.which("openssl") is None:
        pytest.skip("needs the program openssl (Debian package openssl)")

    def make(folder, *flags):
        cert, key = folder / "cert.pem", folder / "key.pem"
        names = ["-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(key), "-out", str(cert)]
        subprocess.run([*MAKE.split(), *names, *flags], check=True, capture_output=True)
        return cert, key

    return make


@pytest.fixture(scope="session")
def certificate(make_certificate, tmp_path_factory):
    """File of a certificate, and the context of a server that has it."""
    from arena_newton.policies.serve.serve_command import make_tls
    from arena_newton.policies.serve.serve_options import ServeOptions

    cert, key = make_certificate(tmp_path_factory.mktemp("certificate"), "-nodes")
    return cert, make_tls(ServeOptions(policy="x", tls_cert=str(cert), tls_key=str(key)))
