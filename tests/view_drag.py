#!/usr/bin/env python3
"""Drags the live view's sliders in Chromium and holds its pictures against what `lasertrace render` writes.

    python3 tests/view_drag.py PROGRAM             checks; ends with code 1 if one fails
    python3 tests/view_drag.py PROGRAM --measure   times from change to picture, for three sizes of the sensor
    python3 tests/view_drag.py PROGRAM --pictures DIR [SCENE]   pictures of the page

PROGRAM is a lasertrace built with --features service. Speaks the DevTools protocol with Python's standard library
alone (report_touch.py). Without Chromium it says so and exits with code 0.
"""

import base64
import json
import os
import pathlib
import re
import socket
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
import zlib

from report_touch import Browser, check, chromium

ROOT = pathlib.Path(__file__).resolve().parent.parent
# A wait's end: far beyond what a picture takes on a busy machine, so that only what never comes fails.
PATIENCE_S = 600


def scene_of(columns, rows, folder):
    """The bracket's scene, seen by a sensor of as many pixels over the same field, each as bright."""
    text = (ROOT / "scenes/bracket/scene.toml").read_text()
    times = 1280 / columns
    for old, new in [
        ("bracket.stl", str(ROOT / "scenes/bracket/bracket.stl")),
        ("[1280, 512]", f"[{columns}, {rows}]"),
        ("pixel_pitch_um = 5.5", f"pixel_pitch_um = {5.5 * times}"),
        ("quantum_efficiency = 0.5", f"quantum_efficiency = {0.5 / times**2}"),
    ]:
        assert old in text, old
        text = text.replace(old, new)
    path = pathlib.Path(folder) / f"{columns}x{rows}.toml"
    path.write_text(text)
    return path


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Server:
    """`lasertrace view` of a scene."""

    def __init__(self, program, scene, port=0):
        self.process = subprocess.Popen([program, "view", str(scene), "--quiet", "--json", "--listen", f"127.0.0.1:{port}"],
                                        stdout=subprocess.PIPE, text=True)
        started = self.process.stdout.readline()
        if not started:
            raise SystemExit("lasertrace view ended before it answered; is it built with --features service?")
        self.address = json.loads(started)["address"]

    def get(self, path):
        with urllib.request.urlopen(self.address + path, timeout=PATIENCE_S) as answer:
            return answer.read()

    def cpu_s(self):
        times = pathlib.Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")

    def end(self):
        self.process.terminate()
        return self.process.wait(10)


class Page:
    def __init__(self, browser, address, size, mobile=False):
        self.browser = browser
        browser.window(*size, mobile)
        browser.call("Page.navigate", url=address)
        self.wait("document.body?.dataset.final !== undefined && !document.getElementById('check').classList.contains('waiting')")

    def value(self, expression):
        answer = self.browser.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise SystemExit(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, condition):
        end = time.monotonic() + PATIENCE_S
        while not self.value(condition):
            if time.monotonic() > end:
                raise SystemExit(f"never came: {condition}; the page says: {self.status()}")
            time.sleep(0.02)

    def status(self):
        return self.value("document.getElementById('status')?.textContent")

    def text(self, key):
        return self.value(f"document.getElementById('{key}').value")

    def slider(self, key):
        """Middle of a slider's ends, px of the window, after it is scrolled there."""
        element = f"document.querySelector('[data-key={key}] [type=range]')"
        self.value(f"{element}.scrollIntoView({{block: 'center'}})")
        left, top, width, height = self.value(f"(r => [r.x, r.y, r.width, r.height])({element}.getBoundingClientRect())")
        share = self.value(f"({element}.value - {element}.min) / ({element}.max - {element}.min)")
        # The thumb's middle moves between half its width from either end.
        thumb = 16
        return left + thumb / 2 + share * (width - thumb), top + height / 2

    def mouse(self, kind, x, y):
        self.browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=0 if kind == "mouseReleased" else 1, clickCount=1)

    def type(self, key, text):
        field = f"document.getElementById('{key}')"
        self.value(f"{field}.value = '{text}', {field}.dispatchEvent(new Event('change'))")

    def rest(self):
        """Until the final picture of the newest values is there; the values asked for."""
        self.wait("document.getElementById('status').className === 'final' && document.getElementById('save').hasAttribute('href')")
        return self.value("document.body.dataset.final")

    def grey(self):
        """The image on the page, 8 bits a pixel."""
        return base64.b64decode(self.value("""(() => {
            const canvas = document.getElementById("image");
            const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
            let text = "";
            for (let i = 0; i < data.length; i += 4) text += String.fromCharCode(data[i]);
            return btoa(text);
        })()"""))

    def picture(self, path, whole=False):
        data = self.browser.call("Page.captureScreenshot", format="png", captureBeyondViewport=whole)["data"]
        pathlib.Path(path).write_bytes(base64.b64decode(data))


def counts_of(png):
    """Samples of a PNG file of 16 grey bits, not interlaced (RFC 2083)."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, data, size = 8, b"", None
    while at < len(png):
        length, kind = struct.unpack(">I4s", png[at : at + 8])
        content = png[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            size = struct.unpack(">IIBBBBB", content)
            assert size[2:] == (16, 0, 0, 0, 0), size
        elif kind == b"IDAT":
            data += content
        at += 12 + length
    columns, rows = size[:2]
    data, stride, before = zlib.decompress(data), 2 * columns, bytes(2 * columns)
    counts = []
    for row in range(rows):
        start = row * (stride + 1)
        kind, line = data[start], bytearray(data[start + 1 : start + 1 + stride])
        for i in range(stride):
            a, b, c = (line[i - 2], before[i], before[i - 2]) if i > 1 else (0, before[i], 0)
            p = a + b - c
            nearest = min((abs(p - a), 0, a), (abs(p - b), 1, b), (abs(p - c), 2, c))[2]
            line[i] = (line[i] + [0, a, b, (a + b) // 2, nearest][kind]) & 255
        counts += struct.unpack(f">{columns}H", line)
        before = line
    return counts


def as_rendered(program, server, page, query, folder):
    """Whether page and server show what `render` writes of the scene they save."""
    saved = server.get(f"scene.toml?{query}")
    scene = pathlib.Path(folder) / "saved.toml"
    scene.write_bytes(saved)
    frame = int(re.search(r"--frame (\d+)", saved.decode()).group(1))
    subprocess.run([program, "render", str(scene), "--frame", str(frame), "--quiet", "-o", folder], check=True,
                   stdout=subprocess.DEVNULL)
    rendered = (pathlib.Path(folder) / f"frame-{frame:06}.png").read_bytes()
    most = 2 ** int(re.search(r"bit_depth = (\d+)", saved.decode()).group(1)) - 1
    seen = bytes(round(255 * (count / most) ** (1 / 2.2)) for count in counts_of(rendered))
    # Where a shade lies half way between two, Python and Rust may round to either.
    off = max(abs(a - b) for a, b in zip(seen, page.grey(), strict=True))
    return server.get(f"picture.png?{query}") == rendered, off <= 1, rendered


def checks(program, browser, folder):
    port = free_port()
    scene = scene_of(320, 128, folder)
    server = Server(program, scene, port)
    page = Page(browser, server.address, (1366, 768))
    same, seen, first = as_rendered(program, server, page, page.rest(), folder)
    yield check("the first picture has the bytes that render writes", same)
    yield check("and the page shows them", seen)

    # The frame: one in which the bracket is in the light.
    page.type("frame", 110)
    page.rest()
    before = page.grey()
    x, y = page.slider("exposure_ms")
    page.mouse("mousePressed", x, y)
    drafts = set()
    for step in range(1, 31):
        page.mouse("mouseMoved", x + 2 * step, y)
        time.sleep(0.05)
        drafts.add(page.grey())
    end = time.monotonic() + PATIENCE_S
    while len(drafts) < 3 and time.monotonic() < end:
        time.sleep(0.05)
        drafts.add(page.grey())
    yield check(f"the image changes while the slider is dragged ({len(drafts)} pictures)", len(drafts) >= 3)
    page.mouse("mouseReleased", x + 60, y)
    query = page.rest()
    yield check(f"the exposure was dragged up ({query})", float(page.text("exposure_ms")) > 0.06 and "exposure_ms" in query)
    same, seen, later = as_rendered(program, server, page, query, folder)
    yield check("the final picture has the bytes that render writes of the saved scene", same)
    yield check("and the page shows them", seen)
    yield check("which are others than before", later != first and page.grey() != before)

    for key, text in [("angle_deg", 40), ("f_number", 11), ("power_mw", 4), ("rx_deg", 3), ("ry_deg", -4), ("rz_deg", 5),
                      ("x_mm", 1.5), ("y_mm", -2), ("z_mm", 3)]:
        page.type(key, text)
    query = page.rest()
    same, seen, _ = as_rendered(program, server, page, query, folder)
    yield check(f"all values together: the bytes that render writes ({query})", same)
    yield check("and the page shows them", seen)

    page.type("f_number", 0)
    page.wait("document.getElementById('f_number').getAttribute('aria-invalid') === 'true'")
    said = page.value("document.getElementById('f_number-wrong').textContent")
    yield check(f"a wrong value is said beside its field ({said})", "found 0" in said and "expected" in said)
    page.type("f_number", "eight")
    yield check("and what is no number too", "eight" in page.value("document.getElementById('f_number-wrong').textContent"))
    page.type("f_number", 8)
    page.rest()
    yield check("a right value takes that away", page.value("document.getElementById('f_number-wrong').textContent") == "")

    page.value("document.querySelector('[data-key=frame] [type=range]').focus()")
    for kind in ["keyDown", "keyUp"]:
        browser.call("Input.dispatchKeyEvent", type=kind, key="ArrowRight", code="ArrowRight", windowsVirtualKeyCode=39)
    query = page.rest()
    yield check("the arrow keys go from frame to frame", page.text("frame") == "111" and "frame=111" in query)
    frame = page.value("document.getElementById('facts').textContent")
    yield check(f"which the picture shows ({frame})", frame.startswith("frame 111: "))

    server.process.kill()
    server.process.wait()
    page.type("frame", 100)
    page.wait("document.getElementById('status').textContent.includes('does not answer')")
    yield check("the page says that the program is gone", page.value("document.getElementById('picture').className") == "waiting")
    server = Server(program, scene, port)
    page.rest()
    yield check("and goes on when it is back", page.value("document.getElementById('facts').textContent").startswith("frame 100: "))

    page = Page(browser, server.address, (390, 844), True)
    x, y = page.slider("power_mw")
    was = page.text("power_mw")
    browser.drag(lambda way: [[x - 60 * way, y]])
    page.rest()
    yield check(f"a finger drags a slider ({was} to {page.text('power_mw')} mW)", float(page.text("power_mw")) < float(was))
    for width, height, mobile in [(390, 844, True), (1366, 768, False), (1920, 1080, False)]:
        browser.window(width, height, mobile)
        wide = page.value("document.scrollingElement.scrollWidth")
        yield check(f"the page fits {width} px (is {wide} px wide)", wide <= width)
    yield check("Ctrl-C ends the program in order", server.end() == 0)


def measure(program, browser, folder):
    changes, drag_s = 200, 8
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the start")
    print("| sensor, px | change to picture, ms: median | 95 % | made in, ms: median | CPU of the program, ms a picture "
          "| pictures a second while dragging | final picture, ms: median |")
    print("|---|---|---|---|---|---|---|")
    for columns, rows in [(320, 128), (640, 256), (1280, 512)]:
        server = Server(program, scene_of(columns, rows, folder))
        page = Page(browser, server.address, (1366, 768))
        page.type("frame", 110)
        page.rest()
        page.value("""window.change = (share) => new Promise((done) => {
            const range = document.querySelector("[data-key=exposure_ms] [type=range]");
            const start = performance.now(), was = document.body.dataset.drawn;
            const seen = new MutationObserver(() => {
                if (document.body.dataset.drawn === was) return;
                seen.disconnect();
                const took = Number(document.getElementById("status").textContent.match(/of them (\\d+)/)?.[1]);
                // Until the browser paints.
                requestAnimationFrame(() => setTimeout(() => done([performance.now() - start, took])));
            });
            seen.observe(document.body, { attributes: true });
            range.value = range.min * (1 - share) + range.max * share;
            range.dispatchEvent(new Event("input"));
        })""")
        cpu = server.cpu_s()
        times = [page.value(f"change({0.4 + 0.2 * (i % 50) / 50})") for i in range(changes)]
        cpu = (server.cpu_s() - cpu) / changes * 1e3
        times, made = sorted(t for t, _ in times), statistics.median(m for _, m in times)
        rate = page.value(f"""new Promise((done) => {{
            const range = document.querySelector("[data-key=exposure_ms] [type=range]"), start = performance.now();
            let pictures = 0, i = 0;
            const seen = new MutationObserver((all) => (pictures += all.length));
            seen.observe(document.getElementById("status"), {{ childList: true }});
            const step = () => {{
                if (performance.now() - start > {1e3 * drag_s}) return seen.disconnect(), done(pictures / {drag_s});
                range.value = range.max * (0.4 + 0.002 * (i++ % 100));
                range.dispatchEvent(new Event("input"));
                setTimeout(step, 8);
            }};
            step();
        }})""")
        page.rest()
        final = sorted(timed(server, f"final?frame=110&exposure_ms={0.05 + 1e-4 * i}") for i in range(20))
        print(f"| {columns} × {rows} | {statistics.median(times):.0f} | {times[len(times) * 95 // 100]:.0f} | {made:.0f} | {cpu:.0f} "
              f"| {rate:.1f} | {statistics.median(final):.0f} |", flush=True)
        server.end()
    print(f"load {os.getloadavg()[0]:.1f} at the end")


def timed(server, path):
    start = time.monotonic()
    server.get(path)
    return 1e3 * (time.monotonic() - start)


def pictures(program, browser, folder, scene):
    out = pathlib.Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    server = Server(program, scene)
    for width, height, mobile in [(390, 844, True), (1366, 768, False), (1920, 1080, False)]:
        page = Page(browser, server.address, (width, height), mobile)
        frames = int(page.value("document.querySelector('[data-key=frame]').dataset.high"))
        page.type("frame", frames // 2)
        page.rest()
        page.wait("!document.getElementById('check').classList.contains('waiting')")
        page.picture(out / f"{width}.png")
        page.picture(out / f"{width}-whole.png", True)
    page.type("f_number", 0)
    page.wait("document.getElementById('f_number').getAttribute('aria-invalid') === 'true'")
    page.picture(out / "wrong.png")
    server.process.kill()
    server.process.wait()
    page.type("f_number", 8)
    page.wait("document.getElementById('status').textContent.includes('does not answer')")
    page.picture(out / "killed.png")


def main():
    program = str(pathlib.Path(sys.argv[1]).resolve())
    chrome = chromium()
    if not chrome:
        print("Chromium: not installed, SKIPPED: no slider was dragged")
        return
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        browser = Browser(chrome, profile)
        try:
            if "--measure" in sys.argv:
                measure(program, browser, folder)
            elif "--pictures" in sys.argv:
                pictures(program, browser, sys.argv[3], (sys.argv[4:] or [ROOT / "scenes/bracket/scene.toml"])[0])
            else:
                sys.exit(not all(list(checks(program, browser, folder))))
        finally:
            browser.process.terminate()
            browser.process.wait()


if __name__ == "__main__":
    main()
