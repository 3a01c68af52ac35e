"""Where a process of shoal's own takes its modules from."""

import sys

import pytest

from learner.own_processes import module_order


@pytest.mark.parametrize(("first", "options"), [("", ["-m"]), (".", ["-m"]), ("/elsewhere", ["-P", "-m"])])
def test_a_process_that_python_took_from_the_current_folder_goes_on_there(monkeypatch, first, options):
    monkeypatch.setattr(sys, "path", [first, *sys.path])
    assert module_order("deploy", ["train"]) == [sys.executable, *options, "deploy", "train"]
