"""The report page: everything in it, nothing fetched, every number led back to its file."""

import base64
import gzip
import json
import re
import shutil
import subprocess

import pytest
from conftest import ROOT
from test_report import RECORD

from corrmat.cli import main
from corrmat.reporting import plots, provenance, robustness
from corrmat.reporting.page import build_page
from corrmat.reporting.record import Record
from corrmat.reporting.snapshots import PairSnapshot
from corrmat.reporting.writer import null_for_nan

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@pytest.fixture
def results(tmp_path):
    """Two records, one of them with 3-D views and bands, and figure 2."""
    root = tmp_path / "results"
    view = {
        "arm": "DCP_corr",
        "rotation_error_deg": 1.5,
        "shape": 0,
        "source": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        "target": [[0, 0, 1], [1, 0, 1], [0, 1, 1]],
        "match": [0, 1, 3],
        "clean": [[0, 0, 0], [1, 1, 1]],
        "steps": [
            {
                "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "translation": [0, 0, 1],
                "matched": [0, 2, 3],
            }
        ],
    }
    for identity in ("1.1", "outliers"):
        content = json.loads(json.dumps(null_for_nan(RECORD))) | {"id": identity}
        folder = root / "smoke" / "shapes" / identity
        folder.mkdir(parents=True)
        for arm in content["arms"].values():
            arm["trained_at"] = "0" * 12
        if identity == "1.1":
            for arm in content["arms"].values():
                arm["bands"] = [{"band_deg": [0, 30], "match_accuracy": 0.5}]
            snapshots = [view | {"rank": rank} for rank in ("easiest", "median", "hardest")]
            (folder / "snapshots.json").write_text(json.dumps(snapshots))
        (folder / "metrics.json").write_text(json.dumps(content))
        errors = ("DCP", 30), ("DCP", 20), ("DCP_corr", 1), ("DCP_corr", "nan")
        rows = [f"{arm},0,{error},,8" for arm, error in errors]
        head = "arm,band,rotation_error_deg,num_correct,num_matchable"
        (folder / "per_pair.csv").write_text("\n".join([head, *rows]))
    robustness.run(root / "smoke" / "robustness", draws=2)
    return root


def test_every_section_is_there_and_nothing_is_fetched(results):
    html = build_page(results)
    for name in ("summary", "exp-1.1", "exp-outliers", "smoke-shapes-1.1", "robustness"):
        assert f'id="{name}"' in html
    page = html[: html.index("<script>")]  # plotly's code names addresses that it never asks here
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", page)
    assert "@import" not in page
    assert len(html) < 8e6
    assert "0 to 30 deg: correct matches, %" in html
    assert "commit 000000000000 is missing" in html
    packed = re.search(r'id="plots">(.*?)</script>', html)[1]
    plots = json.loads(gzip.decompress(base64.b64decode(packed)))
    drawn = set(re.findall(r'data-plot="([^"]+)"', html))
    assert drawn == set(plots)
    assert {f"smoke-shapes-1.1-{rank}" for rank in ("easiest", "median", "hardest")} < drawn


def test_the_page_of_the_committed_records_is_below_8_megabytes():
    assert len(build_page(ROOT / "results")) < 8e6


def test_every_number_names_the_file_and_the_command_it_comes_from(results):
    html = build_page(results)
    titles = re.findall(r'title="([^"]+)"', html[: html.index("<script>")])
    assert titles
    for title in titles:
        path = re.search(r"results/(\S+?\.json)", title)[1]
        assert (results / path).is_file()
    assert (
        "match_accuracy in results/smoke/shapes/1.1/metrics.json; make exp1.1 SCALE=smoke" in titles
    )
    linked = set(re.findall(r'<a href="#([^"]+)"', html))
    assert linked <= set(re.findall(r'id="([^"]+)"', html))


def test_a_record_of_ones_own_recipe_has_no_make_target():
    record = Record.from_json(RECORD | {"id": "mine", "scale": "laptop", "paper": {}})
    assert provenance.command(record) == "corrmat run --config ... --scale laptop"


def test_the_slider_of_a_view_shows_one_stage_at_a_time(results):
    snapshot = json.loads((results / "smoke/shapes/1.1/snapshots.json").read_text())[0]
    actual = plots.snapshot_plot(PairSnapshot.from_json(snapshot))
    steps = actual["layout"]["sliders"][0]["steps"]
    assert [step["label"] for step in steps] == ["before", "iteration 1"]
    for step in steps:
        assert sum(step["args"][0]["visible"]) == 5
    iterated = plots.snapshot_plot(
        PairSnapshot.from_json(snapshot | {"steps": snapshot["steps"] * 3})
    )
    for step in iterated["layout"]["sliders"][0]["steps"]:
        shown = [
            t["name"]
            for t, v in zip(iterated["data"], step["args"][0]["visible"], strict=True)
            if v
        ]
        assert sorted(shown) == sorted(trace["name"] for trace in actual["data"][5:])
    names = [trace["name"] for trace in actual["data"][5:]]
    assert names == ["target", "source", "right matches", "wrong matches", "called outlier"]
    assert actual["data"][8]["x"] == [1.0, 0.0, None]  # the one wrong match: 1 -> 2
    assert actual["data"][9]["z"] == [1.0]  # the outlier, moved by the transform


def test_a_record_whose_code_has_changed_is_marked(tmp_path):
    def git(*words):
        identity = ["-c", "user.name=t", "-c", "user.email=t@t"]
        process = subprocess.run(
            ["git", *identity, *words], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return process.stdout.strip()

    code = tmp_path / "src" / "corrmat" / "losses.py"
    code.parent.mkdir(parents=True)
    code.write_text("a = 1\n")
    (tmp_path / "configs" / "exp").mkdir(parents=True)
    (tmp_path / "configs" / "exp" / "1.1.yaml").write_text('id: "1.1"\n')
    git("init", "-q")
    git("add", "-A")
    git("commit", "-qm", "first")

    first = git("rev-parse", "--short=12", "HEAD")

    def staleness(commit=first):
        arms = {"DCP": {"trained_at": commit}}
        record = RECORD | {"id": "1.1", "arms": arms}
        return provenance.staleness(Record.from_json(record), tmp_path)

    assert staleness() == ""
    (tmp_path / "README.md").write_text("words change nothing\n")
    assert staleness() == ""
    code.write_text('"""Nor does a docstring."""\n\n# nor a comment\na = (1)\n')
    assert staleness() == ""
    recipe = tmp_path / "configs" / "exp" / "1.1.yaml"
    recipe.write_text("id: '1.1'  # of the paper\n")
    assert staleness() == ""
    recipe.write_text("id: '1.1'\nbaselines: [identity]\nscales: {paper: {seed: 1}}\n")
    assert staleness() == ""  # nor what another scale or a baseline does
    recipe.write_text("id: '1.1'\nseed: 1\n")
    assert staleness() == "changed since: 1.1.yaml"
    git("checkout", "configs")
    code.write_text("a = 2\n")
    assert staleness() == "changed since: losses.py"
    code.write_text("a = 1\n")
    (code.parent / "methods.py").write_text("b = 1\n")
    git("add", "-A")
    assert staleness() == "changed since: methods.py"
    assert staleness("0123456789ab+") == "trained with uncommitted code"


def test_what_cannot_be_written_is_said_in_one_line(tmp_path, results, capsys):
    for words, message in (
        (["report"], "what to write"),
        (["report", str(tmp_path / "none"), "-o", str(tmp_path / "r.html")], "no records in"),
        (["report", str(results), "-o", str(tmp_path / "no" / "r.html")], "no folder"),
    ):
        assert main(words) == 2
        assert message in capsys.readouterr().err
    assert main(["report", str(results), "-o", str(tmp_path / "r.html")]) == 0
    assert (tmp_path / "r.html").stat().st_size > 4e6


FRAME = """<!doctype html><title>frame</title>
<iframe src="report.html" style="width:{width}px;height:9000px;border:0"></iframe>
<pre id="said"></pre>
<script>
const frame = document.querySelector("iframe");
frame.addEventListener("load", () => {{
  const page = frame.contentDocument;
  page.querySelectorAll("details").forEach(fold => {{ fold.open = true; }});
  setTimeout(() => {{
    document.getElementById("said").textContent = JSON.stringify({{
      width: page.documentElement.scrollWidth,
      drawn: page.querySelectorAll(".plot.js-plotly-plot").length,
      plots: page.querySelectorAll(".plot").length,
      views: page.querySelectorAll(".snapshot .gl-container canvas").length,
      sections: [...page.querySelectorAll("section")].map(section => section.id),
      untitled: [...page.querySelectorAll("td a")].filter(a => !a.title.includes("make ")).length,
      lost: [...page.querySelectorAll("td a")].filter(
        a => !page.getElementById(a.getAttribute("href").slice(1))).length,
    }});
  }}, 3000);
}});
</script>"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium at hand")
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_draws_all_of_it_without_a_complaint(width, results, tmp_path):
    """In a frame of that width, as headless windows are no narrower than 500 pixels."""
    (tmp_path / "report.html").write_text(build_page(results))
    path = tmp_path / "frame.html"
    path.write_text(FRAME.format(width=width))
    process = subprocess.run(
        [
            BROWSER, "--headless", "--no-sandbox", "--enable-unsafe-swiftshader",
            "--use-angle=swiftshader", "--enable-logging=stderr",
            "--allow-file-access-from-files", f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=1400,9200", "--virtual-time-budget=9000", "--dump-dom", path.as_uri(),
        ],
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    hints = "GL Driver Message", "Canvas2D: "  # of plotly's speed, not of a mistake
    lines = [line for line in process.stderr.splitlines() if "CONSOLE" in line]
    said = [line for line in lines if not any(hint in line for hint in hints)]
    assert not said, said
    shown = json.loads(re.search(r'<pre id="said">(.+?)</pre>', process.stdout)[1])
    assert shown["width"] <= width
    assert shown["drawn"] == shown["plots"] >= 8
    assert shown["views"] >= 3
    assert {"summary", "exp-1.1", "exp-outliers", "robustness"} <= set(shown["sections"])
    assert shown["untitled"] == shown["lost"] == 0
