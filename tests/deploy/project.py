"""What tests of deployment files need to know of the project."""

import io
import tomllib
from pathlib import Path

from dockerfile_parse import DockerfileParser

ROOT = Path(__file__).parents[2]
CONTAINERFILE = ROOT / "deploy" / "Containerfile"


def project():
    """The [project] table of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def instructions():
    """The container file's instructions, parsed."""
    parser = DockerfileParser(fileobj=io.BytesIO(CONTAINERFILE.read_bytes()))
    return [(part["instruction"], part["value"]) for part in parser.structure if part["instruction"] != "COMMENT"]


def image_ray_version() -> str:
    """The Ray that the image holds."""
    (value,) = [value for name, value in instructions() if name == "ARG" and value.startswith("RAY_VERSION=")]
    return value.partition("=")[2]
