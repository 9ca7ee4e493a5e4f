"""Pictures of both tools' pages in headless Chromium, and the time from key to picture, into benchmark/results/people/.

    python benchmark/people_pages.py

Needs Debian's chromium, `pip install playwright`, and a quiet machine for the times.
"""

import contextlib
import json
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from common import ROOT, commit
from playwright.sync_api import Page, sync_playwright

OUT = ROOT / "benchmark" / "results" / "people"
GAMES = {
    "AppleGame-v0": ["ArrowUp", "ArrowLeft", "ArrowDown", "ArrowRight"],
    "ALE/Gopher-v5": [" ", "ArrowLeft", "ArrowRight"],
    "TorcsLike-v0": ["ArrowUp"],
}
SECONDS, ROUNDS = 12, 3  # of play for the times, each in a round of its own


@contextlib.contextmanager
def server(script: str, *flags: str) -> Iterator[str]:
    """The address of a server, which ends with the block."""
    line = [sys.executable, str(ROOT / "cleanrl_thesis" / script), "--port", "0", *flags]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, text=True)
    try:
        yield re.search(r"http://\S+", process.stdout.readline())[0]
    finally:
        process.terminate()


def tap_keys(page: Page, keys: list[str], seconds: float) -> None:
    """Press one key after the other, each for a moment."""
    rng, end = np.random.default_rng(1), time.time() + seconds
    while time.time() < end:
        key = str(rng.choice(keys))
        page.keyboard.down(key)
        time.sleep(rng.uniform(0.08, 0.25))
        page.keyboard.up(key)
        time.sleep(rng.uniform(0.01, 0.08))


def picture_recorder(browser, env_id: str) -> dict:
    """A picture of a round of practice; quantiles of the time from key to picture, in ms."""
    page, latencies, median = browser.new_page(viewport={"width": 1000, "height": 700}), [], []
    with server("record_human.py", "--env-id", env_id, "--practice", "--seed", "1") as address:
        page.goto(address)
        for _ in range(ROUNDS):
            page.wait_for_selector("#practice:enabled")
            page.click("#practice")
            page.wait_for_selector("#veil", state="hidden", timeout=15_000)
            known = len(page.evaluate("latencies"))
            tap_keys(page, GAMES[env_id], SECONDS / 3)
            page.screenshot(path=OUT / f"record_{env_id.split('/')[-1].split('-')[0].lower()}.png")
            tap_keys(page, GAMES[env_id], 2 * SECONDS / 3)
            new = page.evaluate("latencies")[known:]
            latencies += new
            median.append(round(statistics.median(new), 1))
            if page.is_visible("#stop"):
                page.click("#stop")
        page.close()
    quantiles = np.quantile(latencies, (0.1, 0.5, 0.9)).round(1).tolist()
    return {"keys": len(latencies), "ms at 10, 50 and 90%": quantiles, "median of each round": median}


def picture_study(browser, folder: Path) -> None:
    """Pictures of the consent and of a question."""
    demos = ["--alpha", "0", "--epochs", "1", "--demo-frames", "3600", "--eval-episodes", "1"]
    script = str(ROOT / "cleanrl_thesis" / "distill_hybrid.py")
    subprocess.run([sys.executable, script, *demos, "--run-dir", str(folder / "run")], check=True, capture_output=True)
    cut = ["--prepare", f"human={folder / 'run' / 'demos_synthetic_human'}", "--clips", "2", "--seconds", "3"]
    script = str(ROOT / "cleanrl_thesis" / "sensitivity_test.py")
    subprocess.run([sys.executable, script, "--videos", str(folder / "clips"), *cut], check=True, capture_output=True)
    page = browser.new_page(viewport={"width": 700, "height": 620})
    with server("sensitivity_test.py", "--videos", str(folder / "clips"), "--db", str(folder / "s.sqlite")) as address:
        page.goto(address)
        page.wait_for_selector("#consent:visible")
        page.screenshot(path=OUT / "study_consent.png")
        page.check("#agree")
        page.click("#join")
        page.click("#start")
        page.click("#play")
        page.wait_for_selector("#question:visible", timeout=30_000)
        page.click("[data-verdict=human]")
        page.fill("#why", "takes a moment before it turns to the new apple")
        page.set_viewport_size({"width": 700, "height": 1060})
        page.screenshot(path=OUT / "study_question.png")
        page.close()


def main() -> int:
    OUT.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as folder:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        times = {env_id: picture_recorder(browser, env_id) for env_id in GAMES}
        picture_study(browser, Path(folder))
        browser.close()
    about = {"command": "python benchmark/people_pages.py", "commit": commit()}
    (OUT / "latency.json").write_text(json.dumps({**about, **times}, indent=2) + "\n")
    print(json.dumps(times, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
