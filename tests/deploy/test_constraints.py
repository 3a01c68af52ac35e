"""The constraints file: it satisfies pyproject.toml's requirements, and its releases install on any machine."""

import importlib.util
import re

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.deploy.project import ROOT, project

FILE = ROOT / ".ci" / "constraints.txt"


def constraints():
    """The program that writes the file."""
    spec = importlib.util.spec_from_file_location("constraints", ROOT / ".ci" / "constraints.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def pinned():
    """(name, version) of every line."""
    lines = [line for line in FILE.read_text().splitlines() if not line.startswith("#")]
    return [tuple(line.split("==")) for line in lines]


def installed_extras():
    """The extras that the Makefile installs with these constraints."""
    found = re.findall(r"\$\(INSTALL\) '\.\[([a-z,]+)\]'", (ROOT / "Makefile").read_text())
    return {extra for extras in found for extra in extras.split(",")}


def requirements(extras):
    """The requirements of pyproject.toml with some extras, including the extras that an extra names."""
    optional = project()["optional-dependencies"]
    found = [Requirement(line) for line in project()["dependencies"]]
    found += [Requirement(line) for extra in extras for line in optional[extra]]
    (own,) = [requirement for requirement in found if requirement.name == "shoal"]
    found += [Requirement(line) for extra in own.extras for line in optional[extra]]
    return [requirement for requirement in found if requirement.name != "shoal"]


def test_every_line_pins_one_public_release_of_one_package():
    for line in FILE.read_text().splitlines()[1:]:
        assert re.fullmatch(r"[a-z0-9-]+==[0-9][0-9a-z.!]*", line), line  # no address, no local version
    names = [name for name, _ in pinned()]
    assert names == sorted(set(names)) and names == [canonicalize_name(name) for name in names]
    assert not [name for name in names if name.startswith(constraints().CUDA)], "a build for CPUs needs none of them"


def test_every_requirement_is_pinned_within_its_bounds():
    versions = dict(pinned())
    found = requirements(installed_extras())
    assert len(found) > 40
    for requirement in found:
        assert versions[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_the_extras_are_those_that_the_makefile_installs():
    assert set(constraints().EXTRAS) == installed_extras()


@pytest.mark.parametrize("extra", ["dashboard", "export", "s3", "video"])
def test_the_developers_extra_includes_the_extras_of_all_commands(extra):
    (own,) = [line for line in project()["optional-dependencies"]["dev"] if line.startswith("shoal")]
    assert extra in Requirement(own).extras


def test_a_report_of_pip_is_turned_into_pins():
    found = [
        ("Foo_Bar.baz", "1.0"),
        ("torch", "2.13.0+cpu"),
        ("nvidia-nccl-cu12", "2.0"),
        ("shoal", "0.1.0"),
        ("a", "3!1"),
    ]
    report = {"install": [{"metadata": {"name": name, "version": version}} for name, version in found]}
    assert constraints().pins(report) == ["a==3!1", "foo-bar-baz==1.0", "torch==2.13.0"]
