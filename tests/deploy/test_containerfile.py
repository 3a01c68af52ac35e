"""The container file: linted, parsed, and its build context built into a wheel."""

import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from docker.utils.build import PatternMatcher
from packaging.requirements import Requirement

from tests.deploy.project import CONTAINERFILE, ROOT, image_ray_version, instructions, project

IGNORED = CONTAINERFILE.with_name("Containerfile.dockerignore")
HADOLINT = Path(sys.executable).with_name("hadolint")


def lint(path: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([HADOLINT, "--no-color", path], capture_output=True, text=True, check=False)


def test_the_linter_reports_nothing():
    done = lint(CONTAINERFILE)
    assert (done.returncode, done.stdout) == (0, "")


def test_the_linter_finds_a_misspelt_instruction(tmp_path):
    spoilt = tmp_path / "Containerfile"
    spoilt.write_text(CONTAINERFILE.read_text().replace("WORKDIR /opt", "WORKDIRR /opt"))
    assert lint(spoilt).returncode != 0


def values(name: str) -> list[str]:
    return [value for found, value in instructions() if found == name]


def test_the_base_image_names_no_registry_and_fits_the_project():
    (base,) = values("FROM")
    image, version = re.fullmatch(r"([a-z]+):([0-9.]+)-slim", base).groups()
    assert image == "python"
    assert version in project()["requires-python"]


def test_it_does_not_run_as_root():
    assert instructions()[-1][0] == "CMD"
    (user,) = values("USER")
    assert user == "1000:1000", "the user of the manifests' pods"


def test_the_ray_version_satisfies_the_projects_requirement():
    (wanted,) = [Requirement(line) for line in project()["dependencies"] if Requirement(line).name == "ray"]
    assert wanted.specifier.contains(image_ray_version())
    (install,) = [value for value in values("RUN") if "pip install" in value]
    assert f"ray[{','.join(sorted(wanted.extras))}]==${{RAY_VERSION}}" in install


def context() -> set[str]:
    """Files in the build context: those that neither git nor the container's ignore file ignores."""
    patterns = [line for line in IGNORED.read_text().splitlines() if line and not line.startswith("#")]
    ignored = PatternMatcher(patterns)
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    names = filter(None, listed.stdout.decode().split("\0"))
    return {name for name in names if not ignored.matches(name)}


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A folder with the files that the COPY instructions copy."""
    folder = tmp_path_factory.mktemp("image")
    files = context()
    for value in values("COPY"):
        *sources, target = value.split()
        for source in sources:
            found = [name for name in files if name == source or name.startswith(f"{source}/")]
            assert found, f"{source} is not in the context"
            for name in found:
                place = folder / target / name.removeprefix(f"{source}/")
                place = folder / name if target == "./" else place
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, place)
    return folder


def test_the_build_context_holds_only_what_is_copied(copied):
    left = {str(path.relative_to(copied)) for path in copied.rglob("*") if path.is_file()}
    assert left == context()
    assert not [name for name in left if name.startswith(("tests/", "runs/", "dashboards/results/", "."))]


@pytest.mark.slow
def test_the_copied_files_build_a_wheel_with_every_package(copied, tmp_path):
    source = shutil.copytree(copied, tmp_path / "source")  # a build writes into it
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "-w", tmp_path]
    done = subprocess.run([*command, source], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("shoal-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    kept = [name for name in context() if not name.startswith("deploy/examples/")]  # examples are not packaged
    data = ("dashboards/web/", "deploy/configs/")
    sources = {name for name in kept if name.endswith((".py", "/py.typed")) or name.startswith(data)}
    assert sources <= names
    assert {"learner/ray_backend/cluster.py", "sim_core/methods/m_sensor.py", "dashboards/web/player.js"} <= sources
    packages = ("sim_core", "actors", "learner", "deploy", "dashboards")
    assert {"deploy/configs/cartpole.toml", *(f"{name}/py.typed" for name in packages)} <= names
