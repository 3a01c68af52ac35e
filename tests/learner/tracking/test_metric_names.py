"""The table of metrics: complete, valid names for Prometheus, and the same in learner/README.md."""

import re
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from actors.service.messages import TEAM_DTYPE, EpisodeStats
from learner.config import RunConfig
from learner.loop import TrainingLoop
from learner.tracking.journal import Journal, mlflow_metrics
from learner.tracking.metric_names import ENV_STEPS, METRICS
from learner.training.cluster import ProcessCluster
from learner.training.evaluation_summary import as_metrics, summarise
from tests.checkpointing import Silent

README = Path(__file__).parents[3] / "learner" / "README.md"


def journal_names(config: RunConfig, folder: Path) -> set[str]:
    """Names of all metrics in the journal of a run in one process."""
    with closing(Journal(folder / "metrics.jsonl", 0)) as journal:
        loop = TrainingLoop(config, ProcessCluster(config, 0), journal, folder / "checkpoints", Silent(), bool)
        assert loop.run()
        return {name for row in journal.rows() for name in row.metrics}


@pytest.fixture(scope="module")
def written(tmp_path_factory, small_run):
    """Names from a run of our environment, from a run of one without outcomes, and from an evaluation of teams."""
    plain = dict(
        engine="process",
        total_env_steps=2_000,
        envs_per_worker=4,
        min_replay=100,
        batch_size=16,
        hidden_sizes=(8,),
        log_every_env_steps=500,
        eval_every_env_steps=500,
        eval_episodes=2,
    )
    ours = RunConfig(world=small_run.world, **plain)
    other = RunConfig(env_id="CartPole-v1", **plain)
    names = journal_names(ours, tmp_path_factory.mktemp("ours"))
    names |= journal_names(other, tmp_path_factory.mktemp("other"))
    goal, team = np.ones(2, np.int8), np.ones(2, TEAM_DTYPE)
    metrics = as_metrics(summarise(EpisodeStats(goal, np.ones(2, np.int32), np.ones(2), team)))
    return names | {f"eval/{name}" for name in metrics}


def test_the_table_lists_exactly_the_metrics_of_the_journal(written):
    assert {known.journal for known in METRICS} - {ENV_STEPS} == written


def test_names_are_valid_in_prometheus_and_unique():
    for of in ("journal", "name", "series"):
        assert len({getattr(known, of) for known in METRICS}) == len(METRICS)
    for known in METRICS:
        assert re.fullmatch(r"shoal_[a-z_]+[a-z]", known.name)
        text = f"# TYPE {known.series} {known.kind}\n{known.series} 1\n"
        (family,) = text_string_to_metric_families(text)
        assert (family.type, [sample.name for sample in family.samples]) == (known.kind, [known.series])
        assert not known.name.endswith("_total"), "Ray appends it to counters"
        assert (known.unit + known.meaning).isascii(), "Ray's descriptions are ASCII"


def in_mlflow(journal: str) -> str:
    """What the README says of a metric: whether MLflow has it, whose step is the count of env steps."""
    if journal == ENV_STEPS:
        return "step"
    return "yes" if mlflow_metrics({journal: 0.0}) else ""


def test_the_readme_has_the_table():
    lines = README.read_text().splitlines()
    start = lines.index("| metric | in MLflow | in Prometheus | unit | meaning | healthy |") + 2
    rows = [
        f"| `{m.journal}` | {in_mlflow(m.journal)} | `{m.series}` | {m.unit} | {m.meaning} | {m.healthy} |"
        for m in METRICS
    ]
    assert lines[start : start + len(rows) + 1] == [*rows, ""]
