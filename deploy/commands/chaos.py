"""`shoal chaos`: trains a small run under fault injection, and checks what must hold afterwards."""

from __future__ import annotations

from deploy.chaos.config import CONFIG, NAME, write_config
from deploy.chaos.faults import fault_table, with_recovery
from deploy.chaos.injection import ChaosRun
from deploy.chaos.invariants import broken_invariants, final_success
from deploy.console.terminal import plain_console
from deploy.options.training import Chaos
from deploy.runs.folders import make_folder
from learner.tracking.fault_log import read_faults
from sim_core.checks import require


def run(command: Chaos) -> int:
    """Runs the experiment; returns 0 if the run reached its target and all invariants hold, else 1.

    Raises:
      ConfigError: `--out` holds an earlier run, or cannot be written to.
    """
    require(not (command.out / NAME).exists(), f"{command.out / NAME} exists already; name another --out")
    make_folder(command.out, "--out")
    write_config(command.out / CONFIG, command.env_steps)
    console = plain_console()
    chaos = ChaosRun(command, console)
    try:
        chaos.start()
        code = chaos.inject_until_end()
        faults = with_recovery(chaos.injected, read_faults(chaos.folder.faults)) + chaos.outages
        wrong = broken_invariants(chaos.folder) if code == 0 else [f"exit code {code}:\n{chaos.driver.tail(30)}"]
        success = final_success(chaos.folder) if code == 0 else ""
    except TimeoutError as error:
        faults, wrong, success = chaos.injected + chaos.outages, [str(error)], ""
    finally:
        chaos.end()
    console.print(fault_table(faults))
    for sentence in wrong:
        console.print(sentence, soft_wrap=True)
    if not wrong:
        console.print(f"{len(faults)} faults; target reached, accounts balance, MLflow has every row once")
        console.print(f"success rate {success}")
    return 1 if wrong else 0
