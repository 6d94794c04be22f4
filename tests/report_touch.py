#!/usr/bin/env python3
"""Looks at a scan's report in Chromium as on a telephone, and touches its 3D view.

    python3 tests/report_touch.py out/scan/report.html

Holds that the page is no wider than its window, at 390, 1366 and 1920 px; that one finger moved up and down
over the 3D view scrolls the page and leaves the view; that one moved sideways turns the view; and that two
fingers zoom the view, by as much as they move apart, and not the page. Speaks the DevTools protocol over
pipes, with Python's standard library alone. Without Chromium it says so and exits with code 0.
"""

import json
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time

FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--disable-quic", "--no-first-run",
         "--disable-background-networking", "--disable-component-update", "--disable-sync", "--touch-events=enabled",
         "--remote-debugging-pipe"]


class Browser:
    """A page in headless Chromium."""

    def __init__(self, program, profile):
        read_here, write_there = os.pipe()
        read_there, write_here = os.pipe()

        def pipes():
            # Chromium reads commands from 3 and writes answers to 4.
            ends = [os.dup(read_there), os.dup(write_there)]
            os.dup2(ends[0], 3)
            os.dup2(ends[1], 4)

        self.process = subprocess.Popen([program, *FLAGS, f"--user-data-dir={profile}"], preexec_fn=pipes,
                                        close_fds=False, stderr=subprocess.DEVNULL)
        os.close(read_there)
        os.close(write_there)
        self.commands, self.answers = os.fdopen(write_here, "wb"), os.fdopen(read_here, "rb")
        self.rest, self.number, self.session = b"", 0, None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]

    def call(self, method, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session:
            message["sessionId"] = self.session
        self.commands.write(json.dumps(message).encode() + b"\0")
        self.commands.flush()
        while True:
            while b"\0" not in self.rest:
                piece = self.answers.read1(1 << 16)
                if not piece:
                    raise SystemExit("Chromium ended before it answered")
                self.rest += piece
            text, self.rest = self.rest.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("id") == self.number:
                if "error" in answer:
                    raise SystemExit(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def value(self, expression):
        result = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return result["result"].get("value")

    def window(self, width, height, mobile):
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)
        self.call("Emulation.setTouchEmulationEnabled", enabled=mobile, maxTouchPoints=2 if mobile else 1)

    def open(self, address):
        self.call("Page.navigate", url=address)
        for _ in range(200):
            if self.value("document.readyState") == "complete" and self.view():
                return
            time.sleep(0.05)
        raise SystemExit("the report does not show its 3D view")

    def view(self):
        """Heading and height (rad), zoom and shift of the 3D view."""
        text = self.value("document.getElementById('viewer')?.dataset.view ?? ''")
        return json.loads(text) if text else None

    def drag(self, places):
        """Fingers put down at places(0), moved to places(1) and lifted."""
        steps = 20
        for step in range(steps + 1):
            kind = "touchMove" if step else "touchStart"
            points = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(places(step / steps))]
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
            time.sleep(0.016)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        # What was moved comes to rest.
        time.sleep(0.5)


def check(what, holds):
    print(f"{what}: {'yes' if holds else 'NO'}")
    return holds


def touched(browser, address):
    """What holds of the page on a telephone."""
    browser.window(390, 844, True)
    browser.open(address)
    box = "document.querySelector('#viewer canvas').getBoundingClientRect()"
    browser.value("document.querySelector('#viewer canvas').scrollIntoView({block: 'center'})")
    x, y, width = (browser.value(f"{box}.{side}") for side in ["x", "y", "width"])
    middle = [x + width / 2, y + browser.value(f"{box}.height") / 2]
    yaw, pitch, zoom, *_ = browser.view()
    scrolled = browser.value("scrollY")
    browser.drag(lambda way: [[middle[0], middle[1] - 200 * way]])
    yield check("one finger up and down scrolls the page", browser.value("scrollY") > scrolled + 100)
    yield check("and leaves the view", browser.view()[:3] == [yaw, pitch, zoom])
    browser.value("document.querySelector('#viewer canvas').scrollIntoView({block: 'center'})")
    scrolled = browser.value("scrollY")
    browser.drag(lambda way: [[middle[0] + 100 * way, middle[1]]])
    yield check("one finger sideways turns the view", abs(browser.view()[0] - yaw) > 0.4)
    yield check("and leaves the page", browser.value("scrollY") == scrolled)
    browser.drag(lambda way: [[middle[0] + side * 40 * (1 + way), middle[1]] for side in [-1, 1]])
    # Apart twice as far; fingers come in whole pixels.
    yield check("two fingers zoom the view by as much as they part", abs(browser.view()[2] / zoom / 2 - 1) < 0.05)
    yield check("and not the page", browser.value("visualViewport.scale") == 1 and browser.value("scrollY") == scrolled)


def chromium():
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


def main():
    address = pathlib.Path(sys.argv[1]).resolve().as_uri()
    program = chromium()
    if not program:
        print("Chromium: not installed, skipped")
        return
    with tempfile.TemporaryDirectory() as profile:
        browser = Browser(program, profile)
        try:
            all_hold = []
            for width, height, mobile in [(390, 844, True), (1366, 768, False), (1920, 1080, False)]:
                browser.window(width, height, mobile)
                browser.open(address)
                wide = browser.value("document.scrollingElement.scrollWidth")
                all_hold.append(check(f"the page fits {width} px (is {wide} px wide)", wide <= width))
            all_hold += touched(browser, address)
        finally:
            browser.process.terminate()
            browser.process.wait()
    sys.exit(not all(all_hold))


if __name__ == "__main__":
    main()
