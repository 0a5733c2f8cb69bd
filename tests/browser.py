# SPDX-License-Identifier: Apache-2.0
"""Headless Chromium without a network, for tests marked `browser`."""

import contextlib
import json
import shutil
import time

import cv2
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--window-size=1000,1500", "--hide-scrollbars", "--force-device-scale-factor=1", "--host-resolver-rules=MAP * ~NOTFOUND",
)  # fmt: skip


class Page:
    """A page in the browser."""

    def __init__(self, driver):
        self.driver = driver

    def evaluate(self, script):
        """What a script returns."""
        return self.driver.execute_script(f"return {script}")

    def click(self, element_id):
        self.driver.find_element("id", element_id).click()
        time.sleep(0.3)

    def picture(self, element_id="view"):
        """Pixels (H, W, 3) of an element as the browser shows it."""
        data = self.driver.find_element("id", element_id).screenshot_as_png
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)

    def drag(self, element_id, du, dv):
        from selenium.webdriver.common.action_chains import ActionChains

        element = self.driver.find_element("id", element_id)
        ActionChains(self.driver).move_to_element(element).click_and_hold().move_by_offset(du, dv).release().perform()
        time.sleep(0.3)

    def errors(self):
        """What the console complained of."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def requests(self):
        """Addresses that the page asked for, but for its own and those of its data."""
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        found = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        return [address for address in found if not address.startswith(("file://", "data:"))]


@contextlib.contextmanager
def opened(path):
    """A file in the browser; skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver")
    binary, driver_binary = next((b for name in NAMES if (b := shutil.which(name))), None), shutil.which("chromedriver")
    if binary is None or driver_binary is None:
        pytest.skip("no chromium with chromedriver (Debian: apt-get install chromium chromium-driver)")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in FLAGS:
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(driver_binary))
    try:
        driver.get(path.resolve().as_uri())
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline and not driver.execute_script("return document.readyState === 'complete'"):
            time.sleep(0.1)
        yield Page(driver)
    finally:
        driver.quit()
