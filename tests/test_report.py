import json
import re
import shutil
import subprocess
from types import SimpleNamespace

import pytest
from conftest import ROOT
from matplotlib.figure import Figure

from corrmat.errors import CorrmatError
from corrmat.reporting import documents, figures, matrices, overview, tables, writer
from corrmat.reporting.record import Record, read_records

RECORD = {
    "id": "9.9",
    "title": "a test",
    "scale": "smoke",
    "data": "shapes",
    "family": "DCP",
    "baseline": "DCP",
    "treatment": "DCP_corr",
    "controls": [],
    "seed": 0,
    "commit": None,
    "hardware": {"threads": 1, "gpu": False},
    "versions": {},
    "test_pairs": "",
    "bands_deg": [],
    "baselines": {},
    "arms": {
        arm: {
            "match_accuracy": accuracy,
            "relative_euler_rmse_deg": rmse,
            "rotation_error_deg_median": rmse / 2,
            "translation_rmse": 0.1,
            "chamfer": float("nan"),
            "pairs": 8.0,
            "pairs_seen": 32,
            "train_seconds": 90.0,
            "curve": [
                {
                    "pairs_seen": 16, "loss": 1.0, "match_accuracy": 0.1,
                    "relative_euler_rmse_deg": 9.0, "translation_rmse": 0.3,
                }
            ],
        }
        for arm, accuracy, rmse in (("DCP", 0.25, 30.0), ("DCP_corr", 0.5, 3.0))
    },
    "paper": {"DCP": {"match_accuracy": 0.055}, "DCP_corr": {"match_accuracy": 0.999}},
}  # fmt: skip


def test_the_table_has_ours_the_papers_and_both_ratios():
    heads, rows = tables.table(Record.from_json(RECORD))
    entry = {row[0]: row[1:] for row in rows}
    assert heads[1:] == ["DCP", "DCP_corr", "ratio", "paper DCP", "paper DCP_corr", "paper ratio"]
    assert entry["correct matches, %"] == ["25.0", "50.0", "0.5", "5.5", "99.9", "0.0551"]
    assert entry["rotation RMSE (Euler), deg"] == ["30", "3", "10", "", "", ""]
    assert "Chamfer distance (squared)" not in entry  # not a number: not a row
    shown = tables.terminal_table(Record.from_json(RECORD))
    assert "32 pairs in 1.5 min" in shown
    assert len({len(line) for line in shown.splitlines() if "%" in line or "deg" in line}) == 1


def test_a_test_in_bands_is_summed_up_by_the_mean_of_its_bands():
    """The paper gives 1.4 and 2.4 in bands alone, and prints their MAE."""
    bands = {"bands": [{"relative_euler_mae_deg": 1.0}, {"relative_euler_mae_deg": 3.0}]}
    paper = {"DCP": bands, "DCP_corr": {"bands": [{"relative_euler_mae_deg": 0.5}, {}]}}
    arms = {arm: entry | {"relative_euler_mae_deg": 7.0} for arm, entry in RECORD["arms"].items()}
    shown = tables.markdown_summary(
        [Record.from_json(RECORD | {"arms": arms, "bands_deg": [0, 9], "paper": paper})]
    )
    ours, theirs = shown.splitlines()[2:]
    assert "| 7 → 7 |" in ours
    assert "| 2 → - |" in theirs


def test_refresh_writes_between_the_marks_and_nowhere_else(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- results -->\nold\n<!-- /results -->\nafter\n")
    documents.replace_between_marks(page, "results", "new")
    assert page.read_text() == "before\n<!-- results -->\nnew\n<!-- /results -->\nafter\n"
    with pytest.raises(CorrmatError, match="has no <!-- tables -->"):
        documents.replace_between_marks(page, "tables", "new")


def test_the_figure_is_drawn_the_same_twice(tmp_path):
    for name in ("a.png", "b.png"):
        figures.draw_curves(Record.from_json(RECORD), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("number", range(1, 10))
def test_any_number_of_panels_is_drawn(number, tmp_path, monkeypatch):
    """Arms of different pace add two panels, a sweep two more: eight do not fill three rows."""
    record = Record.from_json(RECORD)
    some = figures.panels(record)[:1] * number
    monkeypatch.setattr(figures, "panels", lambda _: some)
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, _: drawn.append(len(figure.axes)))
    figures.draw_curves(record, tmp_path / "curves.png")
    assert drawn == [number]


def test_panels_show_training_bands_or_the_sweep():
    shown = figures.panels(Record.from_json(RECORD))
    assert [panel.title for panel in shown][:2] == [
        "training loss, share of its start", "correct matches, %",
    ]  # fmt: skip
    assert {panel.xlabel for panel in shown} == {"training pairs seen"}
    matches = [(c.arm, c.source == "paper", c.y) for c in shown[1].series]
    assert matches == [
        ("DCP", False, [10]), ("DCP", True, [5.5, 5.5]),
        ("DCP_corr", False, [10]), ("DCP_corr", True, [99.9, 99.9]),
    ]  # fmt: skip

    parts = [{"match_accuracy": 0.5, "relative_euler_mae_deg": 2.0, "relative_euler_rmse_deg": 3.0}]
    bands = {"bands": [{"band_deg": [0, 30]} | parts[0]]}
    arms = {arm: entry | bands for arm, entry in RECORD["arms"].items()}
    shown = figures.panels(Record.from_json(RECORD | {"arms": arms, "paper": {"DCP": bands}}))
    assert [panel.title for panel in shown][1] == "rotation MAE (Euler), deg"
    assert [(c.arm, c.source == "paper", c.x, c.y) for c in shown[1].series] == [
        ("DCP", False, [15], [2.0]), ("DCP", True, [15], [2.0]), ("DCP_corr", False, [15], [2.0]),
    ]  # fmt: skip

    sweep = {"sweep": [{"outliers": 0.4} | parts[0]]}
    arms = {arm: entry | sweep for arm, entry in RECORD["arms"].items()}
    shown = figures.panels(Record.from_json(RECORD | {"arms": arms}))
    assert [panel.xlabel for panel in shown][3:] == ["training pairs seen"] + [
        "outliers in the test, %"
    ] * 2
    assert shown[-1].series[0][2:4] == ([40], [3.0])


def test_arms_of_different_pace_are_shown_against_minutes_too():
    arms = {arm: dict(entry) for arm, entry in RECORD["arms"].items()}
    arms["DCP"]["train_seconds"] = 30 * arms["DCP_corr"]["train_seconds"]
    shown = figures.panels(Record.from_json(RECORD | {"arms": arms}))
    assert [panel.title for panel in shown if panel.xlabel == "minutes of training"] == [
        "correct matches, %", "rotation error, mean, deg",
    ]  # fmt: skip
    ends = {s.arm: s.x[-1] for s in shown[-2].series if s.source == "arm"}
    # Half of the 32 pairs, which take DCP_corr 90 seconds and DCP 30 times as long.
    assert ends == {"DCP": 22.5, "DCP_corr": 0.75}


def test_what_the_paper_misprinted_is_marked():
    """RPMNet_corr's Chamfer distance of 120 to 150 degrees in table 2."""
    record = Record.from_json(
        json.loads((ROOT / "results/laptop/shapes/2.4/metrics.json").read_text())
    )
    chamfer = next(p for p in figures.panels(record) if p.title.startswith("Chamfer"))
    marked = [(s.arm, s.x, s.y) for s in chamfer.series if s.source == "misprint"]
    assert marked == [("RPMNet_corr", [135], [0.12e-5])]
    assert [c for row in tables.table(record)[1] for c in row if "misprint" in c] == [
        "1.2e-06 (misprint)"
    ]


@pytest.fixture(scope="module")
def committed():
    return documents.Results(ROOT / "results")


@pytest.mark.parametrize(
    ("page", "name", "content"), documents.TABLES, ids=[name for _, name, _ in documents.TABLES]
)
def test_the_documents_say_what_the_records_say(page, name, content, committed):
    """Fails when a record is committed and `make docs` was not run.

    A record made anew in a working copy differs at least in its minutes: not a mistake.
    """
    changed = subprocess.run(
        ["git", "status", "--porcelain", "--", "results"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    if changed.returncode or changed.stdout.strip():
        pytest.skip("results/ is not as committed")
    text = (ROOT / page).read_text()
    shown = re.search(f"<!-- {name} -->\n(.*)\n<!-- /{name} -->", text, re.DOTALL)
    assert committed.records
    assert shown[1] == content(committed)


def test_every_place_that_the_map_of_the_paper_names_is_there():
    """`file.py`: `symbol` in docs/reproduction.md is defined in that file."""
    text = (ROOT / "docs" / "reproduction.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| ") and "`" in line]
    named = 0
    for row in rows:
        for path, symbols in re.findall(r"`([\w/]+\.py)`: ((?:`\w+`(?:, )?)+)", row):
            code = (ROOT / "src" / "corrmat" / path).read_text()
            for symbol in re.findall(r"`(\w+)`", symbols):
                assert re.search(rf"(def |class |^\s*){symbol}\b", code, re.MULTILINE), (
                    path,
                    symbol,
                )
                named += 1
        for path in re.findall(r"`(configs/[\w./]+)`", row):
            assert (ROOT / path).is_file()
        for target in re.findall(r"`make ([\w.]+)`", row):
            assert target in (ROOT / "Makefile").read_text()
    assert named > 25


def test_the_overview_has_a_panel_for_the_longest_training_of_each_experiment(
    monkeypatch, committed
):
    records = committed.records
    chosen = overview.longest_records(records)
    assert [record.id for record in chosen] == sorted({record.id for record in records})
    longest = {record.id: record.scale for record in chosen}
    assert longest["1.2"] == "overnight"
    drawn = []
    monkeypatch.setattr(overview, "_draw_panel", lambda axes, record: drawn.append(record.id))
    assert overview.draw_overview(chosen).startswith(b"\x89PNG")
    assert drawn == [record.id for record in chosen]
    with pytest.raises(CorrmatError, match="no record to draw"):
        overview.draw_overview([])
    assert overview._curve_points(records[0].arms["DCP"])[0][-1] >= 8000


def test_a_grid_of_panels_has_no_empty_axes(monkeypatch, committed):
    grids = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda f, *a, **k: (grids.append(f), save(f, *a, **k)))
    overview.draw_overview(overview.longest_records(committed.records)[:9])
    (figure,) = grids
    assert [axes.axison for axes in figure.axes] == [True] * 9 + [False] * 3


def test_a_record_that_is_half_written_is_none(tmp_path):
    shutil.copytree(ROOT / "results/laptop/shapes/1.3", tmp_path / "laptop/shapes/1.3")
    shutil.copytree(ROOT / "results/laptop/shapes/1.3", tmp_path / "laptop/shapes/.1.3.partial")
    assert len(read_records(tmp_path)) == 1


def test_the_matrices_of_the_shipped_arms_are_drawn(tmp_path):
    drawn = matrices.draw_matrices(ROOT / "results")
    assert drawn is not None
    assert drawn.startswith(b"\x89PNG")
    assert matrices.draw_matrices(tmp_path) is None


def test_the_drawn_baseline_is_of_the_band_of_the_snapshot(tmp_path):
    """In 1.4 and 2.4 every band has a pair of each shape."""
    snapshot = SimpleNamespace(arm="DCP_corr", shape=3, rotation_error_deg=2.00001)
    transform = " ".join(["1", "0", "0", "0", "1", "0", "0", "0", "1", "0", "0", "{}"])
    rows = [
        ("DCP", 0, 3, 8.0, 0), ("DCP", 1, 3, 170.0, 1), ("DCP", 1, 4, 60.0, 2),
        ("DCP_corr", 0, 3, 9.0, 3), ("DCP_corr", 1, 3, 2.0, 4),
    ]  # fmt: skip
    lines = [f"{a},{b},{s},{e},{transform.format(z)}" for a, b, s, e, z in rows]
    head = "arm,band,shape,rotation_error_deg,transform"
    (tmp_path / "per_pair.csv").write_text("\n".join([head, *lines]))
    result = writer._baseline_result(tmp_path, Record.from_json(RECORD), snapshot)
    assert result.rotation_error_deg == 170
    assert result.translation == [0, 0, 1]


def test_the_papers_ratio_does_not_depend_on_the_order_in_the_recipe():
    paper = dict(reversed(RECORD["paper"].items()))
    heads, rows = tables.table(Record.from_json(RECORD | {"paper": paper}))
    assert heads[-3:] == ["paper DCP", "paper DCP_corr", "paper ratio"]
    assert rows[0][-1] == "0.0551"


def test_a_curve_leaves_out_an_undefined_validation():
    record = json.loads(json.dumps(RECORD).replace("NaN", "null"))
    point = record["arms"]["DCP_corr"]["curve"][0]
    record["arms"]["DCP_corr"]["curve"] = [
        point | {"pairs_seen": n, "match_accuracy": share}
        for n, share in ((8, 0.1), (16, None), (24, 0.3))
    ]
    panels = figures.panels(Record.from_json(record))
    panel = next(panel for panel in panels if "matches" in panel.title)
    (series,) = [s for s in panel.series if s.arm == "DCP_corr" and s.source == "arm"]
    assert series.x == [8, 24]
