"""What must hold after faults: transition counts balance, and MLflow has every row of metrics exactly once."""

from __future__ import annotations

from contextlib import closing

from actors.evaluation.statistics import Estimate, as_percent
from learner.run import resume_point
from learner.run_folder import RunFolder
from learner.tracking.journal import ACCOUNT, FINAL, Journal, Row, mlflow_metrics
from learner.tracking.mlflow_history import MetricValue, MlflowHistory


def final_success(folder: RunFolder) -> str:
    """The final success rate with its interval, read from MLflow; its server must be running."""
    metrics = MlflowHistory(folder.identity()).newest()
    return as_percent(Estimate(*(metrics[f"{FINAL}success_rate{end}"] for end in ("", "_low", "_high"))))


def broken_invariants(folder: RunFolder) -> list[str]:
    """The invariants that a finished run breaks, one sentence each. Its MLflow server must be running."""
    config = folder.config()
    state = resume_point(folder, config)[0].state
    with closing(Journal(folder.journal, state["journal_offset"])) as journal:
        rows = journal.rows()
    wrong = []
    ledger, pacing = state["ledger"], state["pacing"]
    dropped = sum(ledger["dropped"].values())
    if state["env_steps"] < config.total_env_steps:
        wrong.append(f"the run has {state['env_steps']} env steps, not {config.total_env_steps}")
    if ledger["produced"] != ledger["stored"] + dropped:
        wrong.append(f"{ledger['produced']} transitions made are not {ledger['stored']} stored + {dropped} dropped")
    if pacing["inserted"] != ledger["stored"]:
        wrong.append(f"pacing counts {pacing['inserted']} transitions stored, the ledger {ledger['stored']}")
    if pacing["sampled"] != state["updates"] * config.batch_size:
        wrong.append(f"{pacing['sampled']} samples are not those of {state['updates']} updates")
    return wrong + _unbalanced(rows) + _undelivered(folder, rows)


def _unbalanced(rows: list[Row]) -> list[str]:
    """A sentence per row of metrics in which transitions made are not those stored plus those dropped."""
    counts = [(row.env_steps, row.metrics) for row in rows if f"{ACCOUNT}produced" in row.metrics]
    return [
        f"at {env_steps} env steps the accounts do not balance"
        for env_steps, metrics in counts
        if metrics[f"{ACCOUNT}produced"] != metrics[f"{ACCOUNT}stored"] + metrics[f"{ACCOUNT}dropped"]
    ]


def _undelivered(folder: RunFolder, rows: list[Row]) -> list[str]:
    """A sentence per metric whose history in MLflow differs from the journal's, and one if the run is not FINISHED."""
    history = MlflowHistory(folder.identity())
    wrong = []
    for key in sorted({key for row in rows for key in mlflow_metrics(row.metrics)}):
        expected = sorted(
            MetricValue(row.time_ms, row.env_steps, row.metrics[key]) for row in rows if key in row.metrics
        )
        found = sorted(history.metric(key))
        if found != expected:
            wrong.append(f"MLflow has {len(found)} values of {key}, the journal {len(expected)}, or others")
    status = history.status()
    if status != "FINISHED":
        wrong.append(f"MLflow says that the run is {status}")
    return wrong
