"""What must hold after a chaos run: accounts that balance, and every row of metrics in MLflow once."""

from __future__ import annotations

from contextlib import closing

from actors.evaluation.statistics import Estimate, as_percent
from learner.run import resume_point
from learner.run_folder import RunFolder
from learner.tracking.journal import ACCOUNT, FINAL, Journal, Row, charted
from learner.tracking.mlflow_history import MetricValue, MlflowHistory


def success(folder: RunFolder) -> str:
    """What the run learned: its success rate at the end with the interval, from MLflow, whose server must run."""
    metrics = MlflowHistory(folder.identity()).newest()
    return as_percent(Estimate(*(metrics[f"{FINAL}success_rate{end}"] for end in ("", "_low", "_high"))))


def complaints(folder: RunFolder) -> list[str]:
    """What is wrong with a run that has ended, a sentence each; nothing if all is well. Its MLflow server must run."""
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
    """Rows at which the accounts did not balance."""
    accounts = [(row.env_steps, row.metrics) for row in rows if f"{ACCOUNT}produced" in row.metrics]
    return [
        f"at {env_steps} env steps the accounts do not balance"
        for env_steps, metrics in accounts
        if metrics[f"{ACCOUNT}produced"] != metrics[f"{ACCOUNT}stored"] + metrics[f"{ACCOUNT}dropped"]
    ]


def _undelivered(folder: RunFolder, rows: list[Row]) -> list[str]:
    """Metrics whose history in MLflow is not the journal's, in its order."""
    history = MlflowHistory(folder.identity())
    wrong = []
    for key in sorted({key for row in rows for key in charted(row.metrics)}):
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
