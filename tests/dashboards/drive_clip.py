"""Films the page of `shoal watch --drive` in Chromium while sent arrow keys drive a scene of a run.

python -m tests.dashboards.drive_clip runs/RUN dashboards/images/drive.mp4
"""

from __future__ import annotations

import argparse
import io
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dashboards.figures.video import write_mp4
from deploy.drive import drive_server
from deploy.runs.policy_lookup import find_policy
from learner.run_folder import RunFolder
from tests.dashboards.chromium import open_chromium, wait_until

SCREEN = {"width": 980, "height": 800, "deviceScaleFactor": 1, "mobile": False}
STEPS_PER_FRAME = 2
SHEET_FRAMES = 20
HAND = """
const mean = axis => {
  const mates = [...Array(numRobots).keys()].filter(r => r !== data.learner && groupOf(r) === learnerGroup);
  return mates.reduce((sum, robot) => sum + positionOf(robot, axis), 0) / mates.length;
};
const goal = data.goals[learnerGroup];
const to = [0, 1].map(axis => mean(axis) + 0.3 * Math.sign(goal[axis] - mean(axis)) - positionOf(data.learner, axis));
const arrows = [];
if (Math.abs(to[0]) > 0.4 * Math.hypot(...to)) arrows.push(to[0] > 0 ? 'ArrowRight' : 'ArrowLeft');
if (Math.abs(to[1]) > 0.4 * Math.hypot(...to)) arrows.push(to[1] > 0 ? 'ArrowUp' : 'ArrowDown');
return [arrows, step, paths !== null];
"""
"""What a hand that knows the game would hold: the arrows to where its group goes."""


def frames(browser: Any) -> Iterator[NDArray[np.uint8]]:
    """Screenshots of a driven scene, every `STEPS_PER_FRAME` steps, and of what follows."""
    held: set[str] = set()
    last = -STEPS_PER_FRAME
    while True:
        arrows, step, ended = browser.execute_script(HAND)
        if ended:
            break
        for key in held - set(arrows):
            send(browser, "keyUp", key)
        for key in set(arrows) - held:
            send(browser, "keyDown", key)
        held = set(arrows)
        if step >= last + STEPS_PER_FRAME:
            last = step
            yield picture(browser)
    for key in held:
        send(browser, "keyUp", key)
    wait_until(browser, "shown === 'you'")
    steps = browser.execute_script("setPlaying(false); return data.steps")
    for at in range(0, steps + 1, 4 * STEPS_PER_FRAME):
        browser.execute_script("seek(arguments[0])", at)
        yield picture(browser)
    browser.execute_script("seek(data.steps); window.scrollTo(0, document.body.scrollHeight)")
    yield from [picture(browser)] * SHEET_FRAMES


def send(browser: Any, kind: str, key: str) -> None:
    """Sends a key as the keyboard would."""
    browser.execute_cdp_cmd("Input.dispatchKeyEvent", {"type": kind, "key": key, "code": key})


def picture(browser: Any) -> NDArray[np.uint8]:
    """What the browser shows `[height, width, 3]`."""
    return np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"))


def main() -> None:
    """Makes the film; the scenes that are driven for it are kept apart from the run's own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=2_000_000_000)
    arguments = parser.parse_args()
    run = RunFolder(arguments.run)
    config = run.config()
    with tempfile.TemporaryDirectory() as folder, open_chromium(Path(folder) / "chromium") as browser:
        scratch = RunFolder(Path(folder) / run.path.name)
        server = drive_server(scratch, config.world, find_policy(run, config), arguments.seed, 0)
        thread = threading.Thread(target=server.serve)
        thread.start()
        try:
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", SCREEN)
            browser.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})
            browser.get(server.url)
            wait_until(browser, "driving && data !== null")
            browser.execute_script("element('speed').value = '0.25'")
            write_mp4(frames(browser), arguments.out, 1 / (config.world.time_step_s * STEPS_PER_FRAME))
        finally:
            server.close()
            thread.join()


if __name__ == "__main__":
    main()
