"""The job of `shoal submit`: the given command, with a name and a folder that outlast the job."""

from pathlib import Path

import pytest

from deploy.cli import main, parse
from deploy.commands.submit import job_arguments, job_name, run_name
from deploy.options.training import Submit
from learner.config import config_hash


def submitted(*arguments: str):
    """(options, the job's command) of `shoal submit ARGUMENTS`."""
    command = parse(["submit", *arguments])
    assert isinstance(command, Submit)
    return command, command.job


def test_options_of_submit_come_before_the_job_and_the_jobs_own_after_it():
    command, job = submitted("--address", "head:8265", "--stop-wait-s", "9", "train", "--robots", "5", "--address=x")
    assert (command.address, command.stop_wait_s) == ("head:8265", 9)
    assert command.arguments == ("train", "--robots", "5", "--address=x")
    assert (job.run.world.robots, job.launch.address) == (5, "x")


def test_the_job_runs_the_given_command_in_a_folder_that_outlasts_it(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    command, job = submitted("train", "--robots", "5", "--runs-dir", "here", "--seed", "3")
    words = job_arguments(command.arguments, job)
    assert words[:7] == ["train", "--robots", "5", "--runs-dir", "here", "--seed", "3"]
    there = parse(words)
    assert there.run == job.run
    assert there.launch.runs_dir == tmp_path / "here"
    assert there.or_resume and there.launch.name == run_name(job)


def test_a_job_may_be_supervised():
    command, job = submitted("train", "--supervise", "--robots", "5")
    assert parse(job_arguments(command.arguments, job)).supervise and job.supervise


def test_a_jobs_name_is_decided_by_its_settings():
    names = {}
    for arguments in ("", "--robots 10", "--total-env-steps 9000000", "--robots 5", "--seed 1", "--learning-rate 0.1"):
        command, job = submitted("train", *arguments.split())
        names[arguments] = job_name(command.arguments, job)
    assert names[""] == names["--robots 10"] == names["--total-env-steps 9000000"]
    assert len(set(names.values())) == 4
    assert names["--seed 1"].startswith("shoal-train-sensor-10r2g-s1-")
    command, job = submitted("train", "--name", "mine")
    assert job_name(command.arguments, job) == "shoal-train-mine"
    assert config_hash(job.run) in names[""]


def test_a_sweep_keeps_its_default_name_and_needs_no_or_resume(tmp_path):
    command, job = submitted("sweep", "--preset", "best", "--set", "n_step=2", "--runs-dir", str(tmp_path))
    assert job_name(command.arguments, job) == "shoal-sweep-best-n_step-2"
    there = parse(job_arguments(command.arguments, job))
    assert there.launch.name == run_name(job) == "best+n_step=2"
    assert there.launch.runs_dir == tmp_path
    assert there.grid == job.grid


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "train or sweep"),
        (["--stop-wait-s", "0", "train"], "--stop-wait-s"),
        (["train", "--robots", "1"], "robots"),
        (["--working-dir", "/", "train"], "--working-dir / is not a checkout"),
        (["train", "--address", "1.2.3.4:5"], "submit --address"),
    ],
)
def test_bad_input_is_refused_before_anything_is_sent(arguments, words, capsys, monkeypatch):
    monkeypatch.chdir(Path(__file__).parents[3])
    assert main(["submit", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and "Traceback" not in error


def test_a_job_refuses_a_folder_that_would_be_lost(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")
    for command in ("train", "sweep"):
        assert main([command]) == 2
        assert "absolute" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
