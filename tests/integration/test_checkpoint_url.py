"""A run whose checkpoints lie on a real S3 server: trained, damaged, resumed, evaluated and refused."""

import json

import fsspec
import pytest

from deploy.cli import main
from tests.integration.conftest import SMALL, flags

pytestmark = pytest.mark.filterwarnings(
    "ignore:The ``noload`` loader strategy:DeprecationWarning"
)  # MLflow's own query


@pytest.fixture
def trained(s3_server, tmp_path, capsys):
    url = f"{s3_server}/{tmp_path.name}"
    arguments = ("--runs-dir", str(tmp_path / "runs"), "--name", "r", "--checkpoint-url", url, "--keep-best", "0")
    assert main(["train", *arguments, *flags(SMALL)]) == 0
    assert f"{url}/r/step-" in capsys.readouterr().out
    return tmp_path / "runs", f"{url}/r"


def names(url):
    files, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    return files, sorted({name.removeprefix(path + "/").split("/")[0] for name in files.find(path)})


def test_a_run_on_s3(trained, capsys, tmp_path):
    runs, url = trained
    assert not (runs / "r" / "checkpoints").exists(), "nothing is left on this machine"
    files, (older, newest) = names(url)
    files.pipe_file(f"{url}/{newest}/learner.safetensors", b"damaged")
    more = ["--runs-dir", str(runs), "--total-env-steps", "8000"]
    assert main(["resume", "r", *more]) == 0
    output = capsys.readouterr().out
    assert f"skipped: checkpoint {url}/{newest} is damaged (learner.safetensors: 7 bytes, not" in output
    assert f"going on from {url}/{older}" in output
    steps = [json.loads(line)[0] for line in (runs / "r" / "metrics.jsonl").read_text().splitlines()]
    assert len(names(url)[1]) == 2 and max(steps) >= 8000
    assert newest not in names(url)[1], "what was damaged does not push out what is good"
    for which in ("newest", "best", names(url)[1][0]):
        picture = tmp_path / f"{which}.png"
        arguments = ["--runs-dir", str(runs), "--format", "png", "--checkpoint", which, "--out", str(picture)]
        assert main(["watch", "r", *arguments]) == 0 and picture.stat().st_size > 1_000


def test_a_url_that_holds_a_runs_checkpoints_is_refused(trained, capsys, tmp_path):
    url = trained[1].rsplit("/", 1)[0]
    other = ["--runs-dir", str(tmp_path / "other"), "--name", "r", "--checkpoint-url"]
    assert main(["train", *other, url]) == 2
    assert "holds the checkpoints of another run" in capsys.readouterr().err
    assert main(["train", *other, "s3://no-such-bucket-here/x"]) == 2
    assert "cannot be written to" in capsys.readouterr().err
    assert not (tmp_path / "other" / "r").exists(), "nothing was started"
