"""Facts about the project and the machine, for tests of deployment files."""

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
    """Ray's version in the image."""
    (value,) = [value for name, value in instructions() if name == "ARG" and value.startswith("RAY_VERSION=")]
    return value.partition("=")[2]
