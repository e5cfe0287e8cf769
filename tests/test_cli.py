import json
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from conftest import ROOT

import corrmat
from corrmat import options as command_options
from corrmat.cli import main
from corrmat.registration import benchmark
from corrmat.reporting.claims import HIGH_RATE_CONTROL
from corrmat.training import experiment, loggers, recipe
from corrmat.weights import load_model

FIT = ["fit", "--config", str(ROOT / "configs" / "exp" / "1.1.yaml"), "--scale", "smoke"]


def run(*words):
    return subprocess.run([sys.executable, "-m", "corrmat", *words], capture_output=True, text=True)


def test_a_script_of_reproduce_is_the_whole_experiment(tmp_path):
    """What `make exp1.2` calls, from another folder."""
    words = ["--scale", "smoke", "--results", "results", "--runs", "runs"]
    script = ROOT / "reproduce" / "exp1_2.py"
    process = subprocess.run(
        [sys.executable, str(script), *words], capture_output=True, text=True, cwd=tmp_path
    )
    assert process.returncode == 0, process.stderr
    assert "paper DCP_corr" in process.stdout
    assert process.stdout.count("step ") == 4  # a line a validation
    assert "Warning" not in process.stderr
    assert (tmp_path / "results" / "smoke" / "shapes" / "1.2" / "metrics.json").is_file()


def test_the_command_has_the_choices_of_the_library():
    assert get_args(command_options.Scale) == recipe.SCALES
    assert get_args(command_options.Logger) == get_args(loggers.Choice)
    assert get_args(command_options.Protocol) == get_args(benchmark.Protocol)
    assert {*get_args(benchmark.Protocol)} == {*benchmark.PROTOCOLS, *benchmark.SCANS}


def test_public_names_can_be_imported_and_are_listed():
    assert [*corrmat.__all__] == sorted(corrmat.__all__)
    for name in corrmat.__all__:
        assert getattr(corrmat, name) is not None
    assert {*corrmat._MODULES} <= {*corrmat.__all__}


@pytest.mark.parametrize("experiment", ["2.1", "2.2", "2.3", "2.4"])
def test_recipes_have_the_control_that_claims_ask_for(experiment):
    """Without it three kinds of claims would be missing from the ledger."""
    loaded = recipe.load(ROOT / "configs" / "exp" / f"{experiment}.yaml", "laptop")
    assert HIGH_RATE_CONTROL in loaded.controls


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out.strip() == f"corrmat {corrmat.__version__}"


def test_help_teaches_by_example():
    process = run("--help")
    assert process.returncode == 0
    for word in ("corrmat run --config configs/exp/1.1.yaml", "exit codes", "evaluate", "--data.*"):
        assert word in process.stdout


def test_help_of_a_command_lists_typed_settings(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["fit", "--help"])
    shown = capsys.readouterr().out
    for word in (
        "--arm",
        "--data.num_points",
        "--network.width",
        "--trainer.max_steps",
        "--optimizer.lr",
    ):
        assert word in shown


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--data.nump", "3"], "nrecognized arguments: --data.nump 3"),
        (["--data.num_points", "many"], "data.num_points"),
        (["--data.sampling", "some"], "identical"),
        (["--data.keep", "7"], "keep = 7.0 is out of range"),
        (["--trainer.max_stepz", "3"], "nrecognized arguments: --trainer.max_stepz"),
        (["--network.width", "33"], "width 33 is not a multiple of 4 heads"),
        (["--network.k", "60"], "too small for DCP_corr, which needs 60"),
        (["--data.num_points", "5000"], "have 2048 points"),
        (["--data.categories", "[sofa, rocket]"], "unknown category 'rocket'"),
        (["--data.data", "modelnet40"], "ROOT="),
        (["--data.data", "modelnet40", "--data.root", "nowhere"], "no ModelNet40 in nowhere"),
        (["--data.name", "../else"], "is not the name of one folder"),
        (["--network.edge_channels", "[0, 0]"], "channels 0 is not positive"),
        (["--trainer.limit_val_batches", "0"], "limit_val_batches 0 leaves nothing to do"),
        (["--trainer.val_check_interval", "0"], "val_check_interval 0 leaves nothing to do"),
        (["--arm", "ICP"], "unknown arm 'ICP'"),
        (["--config", "nowhere.yaml"], "no recipe nowhere.yaml"),
        (["--config", sys.executable], "is not YAML"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(options, message, capsys, tmp_path, monkeypatch):
    monkeypatch.setenv("CORRMAT_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("corrmat.data.shapes.dataset.SIZE", {"train": 60, "test": 10})
    assert main([*FIT, "--runs", str(tmp_path / "runs"), *options]) == 2
    shown = capsys.readouterr()
    assert message in shown.err
    assert len(shown.err.strip().splitlines()) == 1
    assert shown.err.startswith("corrmat: error: ")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "words", [["fit"], ["nonsense"], ["run", "--scale", "huge"], ["data", "--bogus"]]
)
def test_bad_commands_exit_with_2(words, capsys):
    try:
        code = main(words)
    except SystemExit as stopped:  # argparse's own way to refuse
        code = stopped.code
    assert code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["register", "a.ply"], "required: target; see corrmat register --help"),
        (["register", "a.ply", "b.ply", "--jsn", "x"], "see corrmat register --help"),
        (["nonsense"], "see corrmat --help"),
        (["register", "a.ply", "b.ply", "--gif", "a.png"], "the animation is a GIF, a.png has"),
        (["register", "a.ply", "b.ply", "--html", "a.txt"], "the page is HTML, a.txt has"),
        (
            ["register", "a/c.stl", "b/c.obj", "d.ply", "-o", "m"],
            "a/c.stl and b/c.obj would both become m/c.ply: rename one",
        ),
        (["report", "-o", "."], ". is a folder, not a file to write"),
        (["compare", "icp", "--data", "modelnet40"], "or --root ..."),
    ],
)
def test_a_message_says_where_to_look(words, message, capsys):
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_corrmat_alone_says_what_it_can_do(capsys):
    assert main([]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert 5 < len(shown) < 15
    assert any("corrmat register source.ply target.ply" in line for line in shown)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluate", *FIT[1:], "--record", "x.json"], "nrecognized arguments: --record"),
        (["compare", "icp", "--config", "x.yaml"], "nrecognized arguments: --config"),
        (["compare", "icp", "--protoco", "real"], "nrecognized arguments: --protoco"),
        ([*FIT, "--trainer.max_step", "5"], "nrecognized arguments: --trainer.max_step"),
        (["compare", ","], "which models?"),
        (["compare", "icp", "--keep", "1"], "nrecognized arguments: --keep"),
        (["compare", "icp", "--record", "file/x.json"], "cannot write to file"),
        (["compare", "icp", "--record", "."], "is a folder, not a file"),
        ([*FIT, "--runs", "file/x"], "cannot write to file/x"),
        ([*FIT, "--seed", "5000000000"], "seed 5000000000 is not between"),
        (["robustness", "--scale", "smoke", "--results", "file/x"], "cannot write to file/x"),
        (["data", "--root", "x"], "--root and --mirror go with modelnet40"),
        (
            ["data", "modelnet40", "--root", "x", "--sheet", "a.png"],
            "--sheet a.png: draws the embedded",
        ),
        (["data", "modelnet40", "--root", "file/x"], "file"),
        (["register", "a.ply", "b.ply", "-o", "moved.xyz"], "written as PLY"),
        (["register", "a.ply", "b.ply", "--json", "."], "is a folder, not a file"),
        (["register", ".", "b.ply"], "is a folder, not a file of points"),
        (["register", "a", "b", "--refine", "x"], "refine: expected one of 'icp', 'none'. Got"),
        (["register", "a", "b", "--seed", "x"], "--seed: 'x' is no whole number"),
        ([*FIT, "--data.num_points", "x"], "data.num_points: expected int. Got value: x"),
        (["compare", "icp", "--root", "x"], "shapes is made, not read from x"),
        ([*FIT, "--data.root", "x"], "shapes is made, not read from x"),
    ],
)
def test_what_would_do_nothing_or_fail_late_is_said_at_once(
    words, message, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("not a folder")
    assert main(words) == 2
    shown = capsys.readouterr()
    assert message in shown.err
    assert len(shown.err.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_fit_takes_an_arm_that_is_trained_and_evaluate_its_own_checkpoint(tmp_path, capsys):
    """1.4 takes the networks of 1.1; one that it has trained itself goes first."""
    words = [*FIT[1:], "--runs", str(tmp_path), "--trainer.max_steps", "2", "--arm", "DCP_corr"]
    other = [word.replace("1.1.yaml", "1.4.yaml") for word in words]
    assert main(["fit", *words]) == main(["fit", *words]) == main(["fit", *other]) == 0
    assert capsys.readouterr().out.count("trained already: ") == 2
    assert main(["evaluate", *other]) == 0
    assert "/1.1/DCP_corr/best.ckpt" in capsys.readouterr().out
    assert main(["fit", *other, "--fresh"]) == main(["evaluate", *other]) == 0
    assert "checkpoint: " + str(tmp_path / "smoke/shapes/1.4/DCP_corr") in capsys.readouterr().out


def test_a_checkpoint_of_another_network_is_refused(tmp_path, capsys):
    runs = ["--runs", str(tmp_path / "runs")]
    assert main([*FIT, *runs, "--trainer.max_steps", "1"]) == 0
    evaluate = ["evaluate", *FIT[1:], *runs]
    assert main(evaluate) == 0
    assert "rotation_error_deg_mean" in capsys.readouterr().out
    assert main([*evaluate, "--network.width", "64"]) == 2
    assert "does not fit these settings" in capsys.readouterr().err
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(b"PK not a checkpoint")
    assert main([*evaluate, "--checkpoint", str(broken)]) == 2
    assert main([*evaluate, "--checkpoint", str(tmp_path / "none.ckpt")]) == 2
    assert "train first" in capsys.readouterr().err


def test_a_missing_checkpoint_is_named_before_any_shape_is_made(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("CORRMAT_CACHE", str(tmp_path / "cache"))
    words = ["--config", str(ROOT / "configs/exp/1.2.yaml"), "--runs", str(tmp_path / "runs")]
    for checkpoint, message in (([], "train first"), (["none.ckpt"], "train first"), (["2.9/DCP"],
                                "no model '2.9/DCP'")):  # fmt: skip
        assert main(["evaluate", *words, *(f"--checkpoint={each}" for each in checkpoint)]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "cache").exists()


def test_a_shell_completes_commands_and_typed_options():
    process = run("completion", "bash")
    assert process.returncode == 0, process.stderr
    for word in ("register", "--config", "--data.num_points", "--trainer.max_steps"):
        assert word in process.stdout
    checked = subprocess.run(["bash", "-n"], input=process.stdout, capture_output=True, text=True)
    assert checked.returncode == 0, checked.stderr


def test_how_much_is_printed_is_a_choice(tmp_path):
    """Quiet: the table and nothing before it; the test of reproduce/ sees it all."""
    words = [*FIT[1:], "--runs", str(tmp_path / "runs"), "--logger", "none"]
    quiet = run("run", *words, "--results", str(tmp_path / "b"), "--quiet")
    assert "step " not in quiet.stdout
    assert quiet.stdout.lstrip().startswith("1.1  full clouds, any rotation")
    assert not list((tmp_path / "runs").glob("**/wandb"))


@pytest.mark.parametrize(
    "words",
    [
        ["register", "a.ply", "b.ply", "--seed.foo", "3"],
        ["compare", "icp", "--data.rotation_deg", "60"],
        ["run", "--config", "x.yaml", "--seed.foo", "3"],
    ],
)
def test_an_option_with_a_made_up_suffix_is_not_taken_for_the_option(words, capsys):
    assert main(words) == 2
    assert f"unknown option {words[-2]}" in capsys.readouterr().err


@pytest.mark.parametrize("protocol", ["rooms", "dense"])
def test_dense_scans_are_of_no_data_set(protocol, capsys):
    assert main(["compare", "icp", "--protocol", protocol, "--data", "modelnet40"]) == 2
    assert f"{protocol} pairs are procedural" in capsys.readouterr().err


def test_a_checkpoint_of_another_scale_is_named(tmp_path, capsys):
    words = ["--config", str(ROOT / "configs/exp/1.2.yaml"), "--runs", str(tmp_path)]
    there = tmp_path / "smoke/shapes/1.2/DCP_corr/best.ckpt"
    there.parent.mkdir(parents=True)
    there.touch()
    options = ["--data.train_shapes", "20", "--data.test_shapes", "8"]
    assert main(["evaluate", *words, *options]) == 2
    assert "there is one of --scale smoke" in capsys.readouterr().err
    assert main(["evaluate", *words, *options, "--seed", "1"]) == 2
    assert "train first" in capsys.readouterr().err


@pytest.mark.parametrize("scans", [["line.xyz", "good.xyz"], ["good.xyz", "line.xyz", "good.xyz"]])
def test_an_error_in_the_points_names_the_file(scans, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(0).random((50, 3))
    np.savetxt("good.xyz", points)
    np.savetxt("line.xyz", points[:, :1] * np.ones(3))
    assert main(["register", *scans]) == 2
    assert "line.xyz: all points lie on one line" in capsys.readouterr().err


@pytest.mark.parametrize(("command", "default"), [("register", "corrmat"), ("compare", "real")])
def test_help_says_what_an_option_is_by_default(command, default, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([command, "--help"])
    assert f"(default: {default})" in " ".join(capsys.readouterr().out.split())


def test_help_says_the_type_of_a_setting_and_its_default(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["fit", "--help"])
    shown = " ".join(capsys.readouterr().out.split())
    assert "peak of a one-cycle schedule. (type: float, default: 0.001)" in shown
    assert "(type: <class" not in shown


def test_help_of_a_script_says_what_the_script_does():
    words = [sys.executable, ROOT / "reproduce" / "checkpoints.py", "--help"]
    shown = subprocess.run(words, capture_output=True, text=True).stdout
    assert shown.startswith("The trained arms of recorded experiments")


def test_evaluate_takes_shipped_weights(capsys):
    few = ["--data.train_shapes", "20", "--data.test_shapes", "8"]
    words = ["evaluate", "--config", str(ROOT / "configs/exp/1.2.yaml"), *few, "--checkpoint"]
    assert main([*words, "1.2/DCP_corr"]) == 0
    shown = capsys.readouterr().out
    assert "checkpoint: 1.2/DCP_corr" in shown
    accuracy = next(line for line in shown.splitlines() if line.startswith("match_accuracy"))
    assert float(accuracy.split()[1]) > 0.8  # untrained: about 0.01
    assert main([*words, "2.2/RPMNet_corr"]) == 2
    assert "does not fit: a RPMNetwork, where DCP_corr has a DCPNetwork" in capsys.readouterr().err
    assert main([*words, "1.2/DCP_corr", "--network.k", "8"]) == 2
    assert "1.2/DCP_corr has options of its network" in capsys.readouterr().err


def test_evaluate_tests_weights_with_their_own_options(capsys, monkeypatch):
    """Their tensors in the recipe's network would be another network: k, for one, has none."""
    tested = []
    monkeypatch.setattr(
        experiment, "score", lambda method, *_: tested.append(method.network) or [{}]
    )
    monkeypatch.setattr(experiment, "summary", lambda values: {})
    config = str(ROOT / "configs/exp/1.2.yaml")
    few = ["--data.train_shapes", "20", "--data.test_shapes", "8"]
    words = ["evaluate", "--config", config, "--scale", "smoke", *few]
    assert main([*words, "--checkpoint", "1.2/DCP_corr"]) == 0
    (network,) = tested
    smoke = recipe.load(Path(config), "smoke").arms["DCP_corr"].network.k
    assert network.embed.k == load_model("1.2/DCP_corr").embed.k != smoke


def test_evaluate_tests_on_all_that_the_record_has(capsys):
    few = ["--scale", "smoke", "--data.train_shapes", "20", "--data.test_shapes", "8"]
    for name, arm, titles in (
        ("1.4", "DCP_corr", ["0 to 30 deg", "30 to 60 deg", "150 to 180 deg"]),
        ("outliers", "DCP_corr_matchability", ["0% outliers", "10% outliers", "40% outliers"]),
    ):
        config = str(ROOT / f"configs/exp/{name}.yaml")
        words = ["--config", config, *few, "--arm", arm]
        assert main(["fit", *words, "--logger", "none"]) == main(["evaluate", *words]) == 0
        shown = capsys.readouterr().out.splitlines()
        assert set(titles) <= set(shown)
        tables = len([line for line in shown if line.endswith((" deg", " outliers"))])
        tables += name == "outliers"  # the recipe's own share comes first
        assert sum(line.startswith("rotation_error_deg_median") for line in shown) == tables == 6


def test_a_guess_comes_from_a_file_as_json_wrote_it_or_as_numbers(tmp_path, capsys):
    folder = str(tmp_path / "scans")
    assert main(["example", folder]) == 0
    scans = f"{folder}/source.ply", f"{folder}/target.ply"
    words = ["register", *scans, "--model", "icp", "--json", str(tmp_path / "T.json")]
    assert main([*words, "--init", f"{folder}/truth.json"]) == 0
    truth = np.array(json.loads(Path(folder, "truth.json").read_text())["transform"])
    found = json.loads((tmp_path / "T.json").read_text())["transform"]
    np.testing.assert_allclose(np.array(found)[:3, :3], truth[:3, :3], atol=0.01)
    np.testing.assert_allclose(np.array(found)[:3, 3], truth[:3, 3], atol=5)  # mm
    numbers = tmp_path / "T.txt"
    np.savetxt(numbers, truth)
    assert main([*words, "--init", str(numbers)]) == 0
    assert json.loads((tmp_path / "T.json").read_text())["transform"] == found
    capsys.readouterr()
    for content, message in (("1 2 3", "no matrix of 4 x 4"), ("a b", "holds no matrix")):
        numbers.write_text(content)
        assert main([*words, "--init", str(numbers)]) == 2
        assert message in capsys.readouterr().err
    assert main([*words[:2], *scans, "--init", str(numbers)]) == 2
    assert "there are several" in capsys.readouterr().err
    assert main([*words, "--init", "none.txt"]) == 2
    assert "none.txt: no such file" in capsys.readouterr().err


def test_a_page_is_not_written_to_standard_output(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["register", "a.ply", "b.ply", "--html", "-"]) == 2
    assert "the page is HTML, - is standard output" in capsys.readouterr().err
