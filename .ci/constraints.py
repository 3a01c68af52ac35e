"""Writes constraints.txt beside this file: one release of every package that the Makefile installs.

    python .ci/constraints.py [REQUIREMENT ...]

pip resolves pyproject.toml for this machine and Python without installing anything. A requirement, as in
`torch==2.13.0`, holds a package back.
"""

import json
import subprocess
import sys
from pathlib import Path

FILE = Path(__file__).with_name("constraints.txt")
EXTRAS = ("dev", "peers")
"""The extras of pyproject.toml that the Makefile installs."""
CUDA = ("cuda-", "nvidia-", "triton")
"""Names of the packages that only PyTorch's CUDA builds need, which pin them themselves."""


def pins(report: dict) -> list[str]:
    """Lines `name==version`, sorted by name, from pip's installation report.

    Local versions such as PyTorch's `+cpu` are left out, so that a line fits every build of a release.
    """
    found = {}
    for item in report["install"]:
        name = item["metadata"]["name"].lower().replace("_", "-").replace(".", "-")
        if not name.startswith(CUDA) and name != "shoal":
            found[name] = item["metadata"]["version"].partition("+")[0]
    return [f"{name}=={found[name]}" for name in sorted(found)]


def main(requirements: list[str]) -> None:
    """Resolves and writes the file."""
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    command += [f".[{','.join(EXTRAS)}]", *requirements]
    done = subprocess.run(command, cwd=FILE.parents[1], stdout=subprocess.PIPE, check=True)
    made_by = " ".join(["make constraints", *([f'ARGS="{" ".join(requirements)}"'] if requirements else [])])
    header = [f"# One release of every package that the Makefile installs. Made by: {made_by}"]
    FILE.write_text("\n".join([*header, *pins(json.loads(done.stdout))]) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
