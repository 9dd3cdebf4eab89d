"""Certificates for the tests of TLS, made by the openssl command."""
import shutil
import subprocess

import pytest

CURVE = ("ec", "-pkeyopt", "ec_paramgen_curve:P-256")


def openssl(*arguments):
    done = subprocess.run(["openssl", *map(str, arguments)], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 0, done.stderr


class Certificates:
    """An authority in a folder, and who has certificates of it; paths by name."""

    def __init__(self, folder):
        if shutil.which("openssl") is None:
            pytest.skip("needs the openssl command")
        self.folder = folder
        for authority in ("authority", "stranger"):
            openssl("req", "-x509", "-newkey", *CURVE, "-nodes", "-days", "2",
                    "-subj", f"/CN={authority}", "-addext", "keyUsage=keyCertSign",
                    "-keyout", self.key(authority), "-out", self.pem(authority))
        self.made("server", "IP:127.0.0.1")
        self.made("client", "DNS:client")
        self.made("elsewhere", "DNS:elsewhere.example")
        self.made("impostor", "IP:127.0.0.1", "stranger")

    def pem(self, name):
        return self.folder / f"{name}.pem"

    def key(self, name):
        return self.folder / f"{name}.key"

    def made(self, name, alternative, authority="authority"):
        request, more = self.folder / f"{name}.csr", self.folder / f"{name}.ext"
        more.write_text(f"subjectAltName={alternative}\n")
        openssl("req", "-new", "-newkey", *CURVE, "-nodes", "-subj", f"/CN={name}",
                "-keyout", self.key(name), "-out", request)
        openssl("x509", "-req", "-in", request, "-CA", self.pem(authority), "-CAkey",
                self.key(authority), "-CAcreateserial", "-days", "2", "-extfile", more,
                "-out", self.pem(name))

    def options(self, name, authority="authority"):
        """Return the command line's options."""
        return ["--certificate", str(self.pem(name)), "--key", str(self.key(name)),
                "--authority", str(self.pem(authority))]

    def query(self, name, authority="authority"):
        """Return what follows the question mark of an address."""
        return (f"certificate={self.pem(name)}&key={self.key(name)}"
                f"&authority={self.pem(authority)}")
