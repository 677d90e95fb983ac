"""Opens a page in headless Chromium and says what is wrong with it.

    look_at_page.py CHROMIUM PAGE.html WIDTH[,WIDTH...] [--screenshots FOLDER]

One JSON object a width on stdout: console errors, requests beyond the page itself, pictures that do not load, elements
that stick out of the page, tables that scroll without a sign of it, links that lead nowhere, and the smallest letters.
Only Python's own library: the browser is steered through --remote-debugging-pipe, whose messages end with a zero byte.
"""

import base64
import json
import os
import pathlib
import subprocess
import sys
import tempfile

TIMEOUT_S = 120

# Letters of drawings are as large as the drawing is shown; what is hidden is not looked at.
INSPECT = """
(async () => {
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const inside = element => { for (let e = element; e; e = e.parentElement)
    if (['auto', 'scroll', 'hidden'].includes(getComputedStyle(e).overflowX) && e !== document.documentElement) return true;
    return false; };
  const sticking = [...document.querySelectorAll('body *')].filter(e => !e.closest('svg svg') && !inside(e))
    .filter(e => { const r = e.getBoundingClientRect(); return r.width > 0 && r.right > document.documentElement.clientWidth + 1; })
    .map(e => e.tagName + '.' + e.className + ' ' + (e.textContent || '').slice(0, 40)).slice(0, 5);
  const loads = async address => { const image = new Image(); image.src = address;
    try { await image.decode(); return image.naturalWidth > 0; } catch { return false; } };
  const addresses = [...document.querySelectorAll('img')].map(e => e.src)
    .concat([...document.querySelectorAll('svg image')].map(e => e.getAttribute('href')));
  let broken = 0;
  for (const address of addresses) if (!await loads(address)) broken += 1;
  let smallest = 1000, smallestText = '';
  for (const svg of document.querySelectorAll('main svg[viewBox]')) {
    if (svg.parentElement.closest('svg') || svg.getBoundingClientRect().width === 0) continue;
    const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
    for (const text of svg.querySelectorAll('text')) {
      const size = parseFloat(text.getAttribute('font-size')) * scale;
      if (size < smallest) { smallest = size; smallestText = text.textContent; }
    }
  }
  for (const e of document.querySelectorAll('p, td, th, figcaption, span, a, summary, pre')) {
    if (e.getBoundingClientRect().width === 0) continue;
    const size = parseFloat(getComputedStyle(e).fontSize);
    if (size < smallest) { smallest = size; smallestText = e.textContent.slice(0, 40); }
  }
  // What scrolls sideways must look like it.
  const silent = [...document.querySelectorAll('.scroll')].filter(e => e.scrollWidth > e.clientWidth + 1)
    .filter(e => getComputedStyle(e).backgroundAttachment !== 'local, local, scroll, scroll' ||
      innerWidth < 660 && e.previousElementSibling.getBoundingClientRect().height === 0)
    .map(e => e.textContent.slice(0, 40));
  const lost = [...document.querySelectorAll('a[href^="#"]')].map(e => e.getAttribute('href').slice(1))
    .filter(id => !document.getElementById(id));
  return JSON.stringify({ wide, sticking, pictures: addresses.length, broken, smallest_px: smallest, smallest_text: smallestText,
    lost, silent, figures: document.querySelectorAll('.figure').length, font: document.fonts.check('12px Inter') });
})()
"""


class Browser:
    def __init__(self, chromium):
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        read_commands, self.write_fd = os.pipe()
        self.read_fd, write_answers = os.pipe()

        def as_pipes():
            # Chromium reads from 3 and writes to 4.
            commands, answers = os.dup(read_commands), os.dup(write_answers)
            os.dup2(commands, 3)
            os.dup2(answers, 4)

        self.process = subprocess.Popen(
            [chromium, "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars",
             "--no-first-run", "--remote-debugging-pipe", f"--user-data-dir={self.profile.name}", "about:blank"],
            preexec_fn=as_pipes, close_fds=False, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(read_commands)
        os.close(write_answers)
        self.buffer = b""
        self.number = 0
        self.events = []

    def receive(self):
        while b"\0" not in self.buffer:
            more = os.read(self.read_fd, 1 << 20)
            if not more:
                sys.exit("the browser has ended")
            self.buffer += more
        message, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(message)

    def call(self, method, session=None, **parameters):
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if session:
            message["sessionId"] = session
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self.write_fd, data):]
        while True:
            answer = self.receive()
            if answer.get("id") == self.number:
                if "error" in answer:
                    sys.exit(f"{method}: {answer['error']}")
                return answer["result"]
            self.events.append(answer)

    def wait_for(self, event):
        while not any(message.get("method") == event for message in self.events):
            self.events.append(self.receive())

    def close(self):
        self.process.kill()
        self.process.wait()
        self.profile.cleanup()


def look(browser, page, width, screenshots):
    browser.events.clear()
    target = browser.call("Target.createTarget", url="about:blank")["targetId"]
    session = browser.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
    for domain in ["Page", "Runtime", "Log", "Network"]:
        browser.call(f"{domain}.enable", session)
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 700}
    browser.call("Emulation.setDeviceMetricsOverride", session, **size)
    browser.events.clear()
    browser.call("Page.navigate", session, url=page)
    browser.wait_for("Page.loadEventFired")
    answer = browser.call("Runtime.evaluate", session, expression=INSPECT, awaitPromise=True)
    found = json.loads(answer["result"]["value"])
    found["width"] = width
    complaints, requests = [], []
    for event in browser.events:
        method, parameters = event.get("method"), event.get("params", {})
        if method == "Log.entryAdded" and parameters["entry"]["level"] in ("error", "warning"):
            complaints.append(parameters["entry"]["text"])
        elif method == "Runtime.consoleAPICalled" and parameters["type"] in ("error", "warning", "assert"):
            complaints.append(str(parameters["args"]))
        elif method == "Runtime.exceptionThrown":
            complaints.append(parameters["exceptionDetails"]["text"])
        elif method == "Network.requestWillBeSent":
            requests.append(parameters["request"]["url"][:200])
    found["complaints"] = complaints
    found["requests"] = [url for url in requests if url != page and not url.startswith("data:")]
    if screenshots:
        height = browser.call("Page.getLayoutMetrics", session)["cssContentSize"]["height"]
        # Very long pages in several pictures.
        for part in range(0, int(height) + 1, 6000):
            clip = {"x": 0, "y": part, "width": width, "height": min(6000, height - part), "scale": 1}
            if clip["height"] < 1:
                break
            shot = browser.call("Page.captureScreenshot", session, clip=clip, captureBeyondViewport=True)
            name = pathlib.Path(screenshots) / f"{width}-{part // 6000}.png"
            name.write_bytes(base64.b64decode(shot["data"]))
    browser.call("Target.closeTarget", targetId=target)
    return found


def main():
    chromium, page, widths = sys.argv[1:4]
    screenshots = sys.argv[5] if sys.argv[4:5] == ["--screenshots"] else None
    page = pathlib.Path(page).resolve().as_uri()
    browser = Browser(chromium)
    try:
        for width in widths.split(","):
            print(json.dumps(look(browser, page, int(width), screenshots)))
    finally:
        browser.close()


if __name__ == "__main__":
    import signal

    signal.alarm(TIMEOUT_S)
    main()
