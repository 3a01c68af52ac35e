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
    """The browser; the test is skipped, with the reason, if there is none."""
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
    chromium.set_script_timeout(600)  # for busy machines
    try:
        yield chromium
    finally:
        chromium.quit()


def complaints(browser: Any) -> list[dict[str, Any]]:
    """Errors in the console since the last call, including refusals of the content security policy."""
    return [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


def wait_until(browser: Any, condition: str) -> None:
    """Waits until a JavaScript expression is true; it fails after the script's time limit."""
    check = f"let ok = false; try {{ ok = ({condition}); }} catch (e) {{}} ok ? f() : setTimeout(w, 20)"
    browser.execute_async_script(f"const f = arguments[0]; (function w() {{ {check} }})()")


def two_frames(browser: Any) -> None:
    """Waits for two animation frames, in which changes are drawn."""
    browser.execute_async_script(
        "const done = arguments[0]; requestAnimationFrame(() => requestAnimationFrame(() => done()))"
    )


def press(browser: Any, key: str) -> None:
    """Sends a key to the focused element."""
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(browser).send_keys(key).perform()


@contextmanager
def emulate_scheme(browser: Any, scheme: str) -> Iterator[None]:
    """Shows the page in the `light` or `dark` scheme."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    yield
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": []})


@contextmanager
def emulate_width(browser: Any, width_px: int) -> Iterator[None]:
    """Shows the page on a phone's screen of this width."""
    size = {"width": width_px, "height": 700, "deviceScaleFactor": 2, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    yield
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
