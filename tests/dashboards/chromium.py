"""A browser for tests of pages: Debian's Chromium through its driver."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --disable-dev-shm-usage --window-size=1200,900"
).split()


@contextmanager
def open_chromium(profile: Path) -> Iterator[Any]:
    """The browser; the test is skipped by name where there is none."""
    binary = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no Chromium with its chromedriver on PATH")
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    chromium = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    chromium.set_script_timeout(120)  # of a machine that has other work, too
    try:
        yield chromium
    finally:
        chromium.quit()


def complaints(browser: Any) -> list[dict[str, Any]]:
    """Errors in the console since the last call; what the page's policy refuses is one."""
    return [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def wait_until(browser: Any, condition: str) -> None:
    """Waits until a JavaScript expression is true; the script's time limit ends a wait in vain."""
    check = f"let ok = false; try {{ ok = ({condition}); }} catch (e) {{}} ok ? f() : setTimeout(w, 20)"
    browser.execute_async_script(f"const f = arguments[0]; (function w() {{ {check} }})()")


def two_frames(browser: Any) -> None:
    """Waits until what was asked for is drawn."""
    browser.execute_async_script(
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()))"
    )


def press(browser: Any, key: str) -> None:
    """A key for whatever has the focus."""
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(browser).send_keys(key).perform()


@contextmanager
def emulate_scheme(browser: Any, scheme: str) -> Iterator[None]:
    """The page in `light` or `dark`."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    yield
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@contextmanager
def emulate_width(browser: Any, width_px: int) -> Iterator[None]:
    """The page on a telephone's screen."""
    size = {"width": width_px, "height": 700, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    yield
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
