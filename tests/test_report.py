"""Tables and figures of chapter 4 from runs whose scores are known; statistics against rliable and scipy."""

import csv
import importlib
import itertools
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from scipy import stats

sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
from common import UsageError  # noqa: E402

from cleanrl_thesis import ppo_continuous_kle as ppo  # noqa: E402

report = importlib.import_module("report")

UPDATES = "global_step,charts/update_iterations,losses/kl_exact_new_old\n"


def write_run(
    folder, task: str, method: str, k: int, target: float | None, seed: int, returns, iterations, **more
) -> None:
    """A run with an episode every 1,000 steps and an update every 2,048."""
    run = folder / f"{task}_{method}_{k}_{target}_{seed}"
    run.mkdir(parents=True)
    lines = [f"{1000 * (i + 1)},{value},1000\n" for i, value in enumerate(returns)]
    (run / "episodes.csv").write_text("global_step,episodic_return,episodic_length\n" + "".join(lines))
    lines = [f"{2048 * (i + 1)},{value},{0.002 * value}\n" for i, value in enumerate(iterations)]
    (run / "updates.csv").write_text(UPDATES + "".join(lines))
    about = {"env_id": f"kle/{task}", "kle_stop": method == "stop", "kle_rollback": method == "rollback"}
    args = {**about, "d_target": target or 0.03, "update_epochs": k, "seed": seed, "batch_size": 2048}
    (run / "args.json").write_text(json.dumps(args))
    result = {"global_step": 2048 * len(iterations), "steps_per_second": 5_000.0, "training_seconds": 100.0}
    (run / "result.json").write_text(json.dumps({**result, "complete": True, "script_sha256": "0" * 64, **more}))


@pytest.fixture(scope="session")
def study(tmp_path_factory):
    """Two tasks, 102,400 steps: plain PPO is worse the farther K is from 10, early stops are as good as K = 10."""
    folder, rng = tmp_path_factory.mktemp("study") / "runs", np.random.default_rng(0)
    goals = {4: 60, 10: 100, 20: 80, 40: 40, 80: 10}
    for task, seed, k in itertools.product(("Hopper-v2", "HalfCheetah-v2"), (1, 2), report.KS):
        shape = np.linspace(0, 1, 102)
        settings = [("PPO", None, goals[k], k), ("stop", 0.03, 99, 5), ("rollback", 0.03, 98, 5), ("stop", 0.05, 97, 6)]
        for method, target, goal, mean in settings:
            iterations = np.full(50, k) if method == "PPO" else np.minimum(k, np.linspace(mean - 2, mean + 2, 50))
            returns = goal * shape + rng.normal(0, 0.5, 102)
            write_run(folder, task, method, k, target, seed, returns, iterations)
    write_run(folder, "Hopper-v2", "PPO", 10, None, 3, np.zeros(20), np.full(10, 10))  # 20,480 steps
    (folder / "Hopper-v2_PPO_10_None_4").mkdir()  # not done
    return folder


@pytest.fixture(scope="session")
def rows(study):
    rows = [run["row"] for run in report.read_runs(study, 102_400, 1) if "curves" in run]
    for definition in report.SCORES:
        report.normalise(rows, definition)
    return rows


# Reading
def test_what_is_read_of_a_run(study):
    run = report.read_run(102_400, study / "Hopper-v2_stop_80_0.03_2")
    returns = np.loadtxt(study / "Hopper-v2_stop_80_0.03_2" / "episodes.csv", delimiter=",", skiprows=1)[:, 1]
    row = run["row"]
    assert (row["task"], row["method"], row["d_target"], row["K"], row["seed"]) == ("Hopper-v2", "stop", 0.03, 80, 2)
    assert row["last_episode"] == pytest.approx(returns[-1], abs=1e-3)
    assert row["last_50"] == pytest.approx(returns[-50:].mean(), abs=1e-3)
    assert (row["least"], row["greatest"]) == pytest.approx((returns.min(), returns.max()), abs=1e-3)
    assert row["iterations"] == pytest.approx(5) and row["iterations_last_quarter"] == pytest.approx(
        7 - 5.5 * 4 / 49, abs=1e-3
    )
    assert row["mean_kl"] == pytest.approx(0.01) and row["steps"] == 102_400
    assert row["seconds_per_step"] == 1 / 5_000 and row["all_iterations"] == pytest.approx(5)
    assert run["curves"]["return"].shape == (report.BINS,)


def test_the_first_part_of_longer_runs(study):
    """With --steps 20480 every run counts, with its first 20 episodes alone."""
    runs = report.read_runs(study, 20_480, 1)
    assert len(runs) == 2 * 2 * 5 * 4 + 1
    assert all(run["row"]["episodes"] == 20 and run["row"]["steps"] == 20_480 for run in runs)
    whole = next(run["row"] for run in runs if run["row"]["seed"] == 1 and run["row"]["method"] == "stop")
    assert whole["iterations"] < whole["all_iterations"]


def test_curves_are_means_of_parts_of_a_run():
    at = np.array([1, 10, 11, 25, 1000])
    found = report.binned(at, np.array([1.0, 3, 5, 7, 9]), 1_000)
    assert found[:3].tolist() == [2, 5, 7] and found[-1] == 9 and np.isnan(found[3:-1]).all()


# Statistics
def test_ner_in_both_definitions(rows):
    task = [row for row in rows if row["task"] == "Hopper-v2"]
    last = [row["last_episode"] for row in task]
    for row in task:
        expected = (row["last_episode"] - min(last)) / (max(last) - min(last))
        assert row["as tabulated"] == pytest.approx(expected)
        low, high = min(row["least"] for row in task), max(row["greatest"] for row in task)
        assert row["as written"] == pytest.approx((row["last_50"] - low) / (high - low))
    assert max(row["as tabulated"] for row in task) == 1 and min(row["as tabulated"] for row in task) == 0


def test_interquartile_mean_and_its_interval_are_rliable_s():
    metrics, library = (importlib.import_module(f"rliable.{name}") for name in ("metrics", "library"))
    scores = np.random.default_rng(1).gamma(2, 1, (5, 11))  # runs, tasks
    ours = {str(i): scores[:, i] for i in range(11)}
    assert float(report.interquartile_mean(ours)) == pytest.approx(metrics.aggregate_iqm(scores), rel=1e-12)
    middle, low, high = report.bootstrap(report.interquartile_mean, ours)
    theirs, intervals = library.get_interval_estimates(
        {"all": scores}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4_000
    )
    assert middle == pytest.approx(theirs["all"][0])
    assert (low, high) == pytest.approx(tuple(intervals["all"].ravel()), abs=0.15 * (high - low))


def test_interquartile_mean_is_scipy_s_trimmed_mean():
    for runs in (1, 2, 3, 7, 10):
        scores = np.random.default_rng(runs).normal(size=(runs, 3))
        ours = {str(i): scores[:, i] for i in range(3)}
        assert float(report.interquartile_mean(ours)) == pytest.approx(stats.trim_mean(scores.ravel(), 0.25))


@pytest.mark.parametrize("seeds, tasks", [((2, 2), 6), ((5, 2), 6), ((5, 5), 6), ((2, 2), 11), ((2, 2), 2)])
def test_the_interval_of_a_difference_covers_it_at_least_as_often_as_it_says(seeds, tasks):
    """At the study's numbers of seeds and tasks, of 300 intervals, where the noise of tasks differs by e, up or down."""
    rng, hits = np.random.default_rng(0), 0
    for _ in range(300):
        noise = np.exp(rng.normal(size=tasks))
        a, b = (
            {i: rng.normal(mean, noise[i], number) for i in range(tasks)} for mean, number in zip((1.0, 0.5), seeds)
        )
        _, low, high = report.bootstrap(report.minus, a, b)
        hits += low <= 0.5 <= high
    assert 0.93 <= hits / 300 <= 0.99


def test_the_interval_of_one_task_is_welchs():
    rng = np.random.default_rng(1)
    a, b = rng.normal(0, 1, 5), rng.normal(1, 3, 40)
    theirs = stats.ttest_ind(a, b, equal_var=False)
    assert report.freedom({"t": a}, {"t": b}) == pytest.approx(theirs.df)
    assert report.freedom({"t": a[:1]}, {"t": np.ones(3)}) == np.inf and report.widening(np.inf) == pytest.approx(1)
    interval = theirs.confidence_interval()
    assert report.bootstrap(report.minus, {"t": a}, {"t": b})[1:] == pytest.approx(tuple(interval), abs=0.2)


def test_spread_of_two_lists_of_settings():
    settings = [{"a": np.array([1.0, 3]), "b": np.array([4.0])}, {"a": np.array([0.0, 0]), "b": np.array([1.0])}]
    others = [{"a": np.array([5.0]), "b": np.array([5.0])}, {"a": np.array([4.5]), "b": np.array([4.5])}]
    assert report.spread(2)(*settings, *others) == (3 - 0.5) - (5 - 4.5)


# Tables
def test_findings_of_a_study_that_is_as_the_thesis_says(rows):
    found = {finding.claim: finding for finding in report.findings(rows, "as written", is_whole=True)}
    for k, old in ((4, "+0.03"), (20, "+0.11"), (80, "+0.35")):
        finding = found[f"PPO: K = 10 above K = {k}"]
        assert (finding.published, finding.verdict) == (old, "confirmed")
    near = [finding for claim, finding in found.items() if "near PPO at K = 10" in claim]
    assert len(near) == 6 and {finding.verdict for finding in near} == {"confirmed"}
    assert found["PPO: KL divergence at K = 80 above K = 10, powers of ten"].measured.startswith("+0.90 [+0.90, +0.90]")
    assert found["KLE-Stop 0.03 above PPO at the same K = 80"].verdict == "confirmed"
    late = found["KLE-Stop 0.03 at K = 80: more iterations in the last quarter of these steps than in the first"]
    assert late.verdict == "confirmed" and late.measured.startswith("+3.1 [+3.1, +3.1], 2 tasks, 2 seeds")
    ranges = [finding for claim, finding in found.items() if "the range over d_target" in claim]
    assert [finding.claim.split(":")[0] for finding in ranges] == ["KLE-Stop at K = 80", "KLE-Stop at K = 10"]
    assert "d_target (0.03, 0.05) is below PPO's over K (4, 80)" in ranges[0].claim  # as many K as d_target
    tabulated = {f.claim: f for f in report.findings(rows, "as tabulated", is_whole=True)}
    assert tabulated["PPO: K = 10 above K = 80"].published == "+0.34"
    assert all(finding.published == "" for finding in report.findings(rows, "as tabulated", is_whole=False))


def test_interval_over_tasks_is_that_of_a_mean():
    """Of eleven tasks' differences: Student's interval of their mean, by its standard error."""
    rng = np.random.default_rng(0)
    differences = rng.normal(0.3, 0.2, 11)
    groups = [{str(k): np.array([value]) for k, value in enumerate(values)} for values in (differences, np.zeros(11))]
    middle, low, high = report.bootstrap_tasks(report.minus, *groups)
    half = stats.t.ppf(0.975, 10) * differences.std(ddof=1) / 11**0.5
    assert middle == pytest.approx(differences.mean())
    assert (low, high) == pytest.approx((middle - half, middle + half), abs=0.02)


def test_a_claim_that_is_wrong_is_contradicted_and_one_seed_says_by_what(rows):
    worse, better = (report.by_task(report.select(rows, "PPO", k), "as written") for k in (80, 10))
    finding = report.tell("80 above 10", "", report.minus, worse, better)
    assert finding.verdict == "contradicted" and "[-" in finding.measured
    assert report.tell("80 near 10", "", report.minus, worse, better, margin=1.0).verdict == "confirmed"
    single = {task: values[:1] for task, values in worse.items()}
    finding = report.tell("80 above 10", "", report.minus, single, better)
    assert finding.verdict == "contradicted, over tasks" and finding.measured.endswith("2 tasks, 1 to 2 seeds")
    assert "[" not in finding.measured and finding.over_tasks.startswith("[-")
    alone = {"Hopper-v2": single["Hopper-v2"]}
    finding = report.tell("80 above 10", "", report.minus, alone, better)
    assert (
        finding.verdict == "open" and "[" not in finding.measured and finding.measured.endswith("1 task, 1 to 2 seeds")
    )
    assert report.tell("none", "", report.minus, worse, {}) is None
    assert report.tell("other tasks", "", report.minus, worse, {"Ant-v2": np.ones(2)}) is None


def assert_compiles(tex: str) -> None:
    """What LaTeX would stop at: unknown commands, bare special characters, a $ or a brace left open, cells too many."""
    words = ["begin", "end", "caption", "toprule", "midrule", "bottomrule", "mathrm"]
    assert set(re.findall(r"\\([a-z]+|.)", tex)) <= {*words, *"%&_\\"}
    plain = re.sub(r"\\([%&_\\])", "", tex)
    assert plain.replace("µ", "").isascii() and not set(plain) & set('%#~^"')
    assert all(line.count("$") % 2 == 0 and "_" not in re.sub(r"\$[^$]*\$", "", line) for line in plain.splitlines())
    depths = list(itertools.accumulate((char == "{") - (char == "}") for char in plain))
    assert min(depths) == 0 == depths[-1]
    tables = re.findall(
        r"\\begin{table}\n\\caption{[^\n]+}\n\\begin{tabular}{(\w+)}\n(.*?)\\end{tabular}\n\\end{table}\n",
        tex,
        re.DOTALL,
    )
    assert tables and len(tables) == len(re.findall(r"\\begin", tex)) / 2 == len(re.findall(r"\\end", tex)) / 2
    for columns, body in tables:
        rules = re.findall(r"^\\(\w+rule)$", body, re.MULTILINE)
        rows = [line for line in body.splitlines() if not line.endswith("rule")]
        assert rules == ["toprule", "midrule", "bottomrule"] and len(rows) > 1
        for row in rows:
            assert row.endswith(r" \\") and len(re.findall(r"(?<!\\)&", row)) == len(columns) - 1, row


def test_the_whole_report(study, tmp_path):
    report.main(report.Args(runs=study, steps=102_400, out=tmp_path / "out", workers=1))
    text = (tmp_path / "out" / "tables.md").read_text()
    assert "80 runs of 102,400 steps, 80 of them of the study's 1,210; 40 of its 605 settings" in text
    assert "published" not in text.split("## ", 1)[1].replace(
        "| claim | published |", ""
    )  # which is of 2,000,000 steps
    assert "| KLE-Stop, d_target = 0.03 | " in text and "| Hopper-v2 | " in text and "| –" not in text
    with open(tmp_path / "out" / "runs.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 80
    names = {path.name for path in (tmp_path / "out").glob("*.png")}
    figures = {"fig_4_1", "fig_4_2", "fig_4_3", "learning_curves", "heat_map", "profiles"}
    assert names == {f"{name}.png" for name in figures}
    tex = (tmp_path / "out" / "tables.tex").read_text()
    assert tex.count(r"\begin{tabular}") == tex.count(r"\end{table}") == 7 and "$d_\\mathrm{target}$ = 0.03 &" in tex
    assert_compiles(tex)


def test_latex_escapes_and_has_minus_signs():
    text = report.latex([["", "K = 4"], ["Reacher-v2, d_target = 0.03, 5%", "–6 / -6.3 / 1-2"]], "a_b")
    assert "Reacher-v2, $d_\\mathrm{target}$ = 0.03, 5\\% & --6 / $-$6.3 / 1-2 \\\\" in text and "{a\\_b}" in text


@pytest.mark.parametrize("part", ["one run", "no plain PPO", "plain PPO alone", "a task of one's own"])
def test_whatever_part_is_done(part, study, tmp_path):
    names = {"one run": "Hopper-v2_PPO_10_None_1", "no plain PPO": "*_stop_*", "plain PPO alone": "Half*_PPO_*"}
    for folder in study.glob(names.get(part, "Hopper-v2_*_80_*")):
        if (folder / "args.json").exists():
            shutil.copytree(folder, tmp_path / "runs" / folder.name)
            if part == "a task of one's own":
                path = tmp_path / "runs" / folder.name / "args.json"
                path.write_text(path.read_text().replace("kle/Hopper-v2", "Pendulum-v1"))
    report.main(report.Args(runs=tmp_path / "runs", steps=102_400, out=tmp_path / "out", workers=1))
    assert "nan" not in (tmp_path / "out" / "tables.md").read_text()


def test_published_numbers_stand_beside_whole_runs(rows):
    made = {name.split(":")[0]: table for name, table in report.tables(rows, rows, 2_000_000).items()}
    lines = {line[0]: line for line in made["Table 4.2"]}
    assert lines["PPO"][2].startswith("0.65 / ") and lines["KLE-Stop, d_target = 0.03"][4].startswith("0.77 / ")
    assert lines["KLE-Rollback, d_target = 0.025"][5] == "0.72"  # not measured here
    iterations = {line[0]: line for line in made["Table 4.3"]}
    assert iterations["KLE-Stop, d_target = 0.03"][5].startswith("10.56 / 5.00 / ")
    returns = {line[0]: line for line in made["Table 4.4"]}
    assert returns["Ant-v2"][1] == "1070.8" and returns["Hopper-v2"][2].startswith("2442.5 / ")


def test_runs_of_another_study_are_refused(study, tmp_path):
    for name in ("Hopper-v2_PPO_10_None_1", "Hopper-v2_PPO_10_None_2"):
        shutil.copytree(study / name, tmp_path / name)
    shutil.copytree(study / "Hopper-v2_PPO_10_None_1", tmp_path / "again")
    with pytest.raises(UsageError, match="is there twice"):
        report.read_runs(tmp_path, 102_400, 1)
    shutil.rmtree(tmp_path / "again")
    path = tmp_path / "Hopper-v2_PPO_10_None_2" / "args.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "batch_size": 1024}))
    with pytest.raises(UsageError, match="has another batch_size than"):
        report.read_runs(tmp_path, 102_400, 1)


def test_a_folder_without_runs_says_so(tmp_path):
    with pytest.raises(UsageError, match="holds no run of 2,000,000 steps"):
        report.main(report.Args(runs=tmp_path, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_cost_is_that_of_the_study_s_iterations():
    """Speeds of 100 µs + 20 µs an iteration: the line is found, and the sum is that of Table 4.3 and plain PPO."""
    rows = [{"task": "Ant-v2", "seconds_per_step": 1e-4 + 2e-5 * k, "all_iterations": float(k)} for k in report.KS] + [
        {"task": "Hopper-v2", "seconds_per_step": 1e-4, "all_iterations": 4.0}
    ]
    lines = {line[0]: line for line in report.cost_table(rows)}
    iterations = report.study_iterations()
    assert len(iterations) == 55 and sum(iterations[:5]) == 154 and iterations[5] == 2.943
    hours = 2 * 2e6 * sum(1e-4 + 2e-5 * each for each in iterations) / 3600
    assert lines["Ant-v2"][2:4] == ["100.0", "20.00"] and float(lines["Ant-v2"][-1]) == pytest.approx(hours, abs=0.06)
    assert lines["sum of 1 of 11 tasks"][-1] == lines["Ant-v2"][-1] and "Hopper-v2" not in lines


def test_cost_by_runs_that_were_timed_alone(study, tmp_path):
    """`--cost` takes the speeds from another folder, and keeps them beside the tables."""
    timed = tmp_path / "timed"
    for k in (10, 80):
        speed = {"steps_per_second": 1e5 / k}
        write_run(timed, "Hopper-v2", "PPO", k, None, 1, np.zeros(20), np.full(10, k), **speed)
    report.main(report.Args(runs=study, steps=102_400, out=tmp_path / "out", cost=timed, workers=1))
    table = (tmp_path / "out" / "tables.md").read_text().split("Cost of the study")[1]
    assert "| Hopper-v2 | 2 |" in table and "sum of 1 of 11 tasks" in table
    with open(tmp_path / "out" / "cost.csv") as file:
        assert [float(row["seconds_per_step"]) for row in csv.DictReader(file)] == pytest.approx([1e-4, 8e-4])


def test_cost_of_no_finished_run_is_refused_and_nothing_is_lost(study, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "cost.csv").write_text("kept")
    with pytest.raises(UsageError, match="--cost .*: holds no finished run"):
        report.main(report.Args(runs=study, steps=102_400, out=tmp_path / "out", cost=tmp_path / "no", workers=1))
    assert [path.read_text() for path in (tmp_path / "out").iterdir()] == ["kept"]


def test_bands_of_a_profile_are_between_scores_that_were_reached():
    """With two seeds each, no draw is above the greatest score or below the least."""
    rows = [
        {"task": task, "method": "PPO", "d_target": "", "K": 10, "seed": seed, "ner": 0.5 + 0.2 * seed}
        for task in ("a", "b")
        for seed in (0, 1)
    ]
    axes = report.profiles(rows, "ner").axes[0]
    (line,), (band,) = axes.lines, axes.collections
    ends = band.get_paths()[0].vertices
    assert line.get_ydata()[50] == 1 and line.get_ydata()[71] == 0 and line.get_ydata()[60] == 0.5
    assert (ends[ends[:, 0] < 0.495][:, 1] == 1).sum() > 50 and (ends[ends[:, 0] > 0.705][:, 1] == 0).sum() > 50


def test_a_setting_without_all_tasks_is_compared_with_none(rows):
    """KLE-Stop 0.05 at K = 80 on one task of two: not in the interquartile means; of one seed there is no interval."""
    part = [row for row in rows if (row["K"], row["d_target"], row["task"]) != (80, 0.05, "Hopper-v2")]
    part = [row for row in part if row["K"] != 20 or row["seed"] == 1]
    assert report.on_all_tasks(rows, "stop", 80, 0.05) and not report.on_all_tasks(part, "stop", 80, 0.05)
    third = [{**row, "seed": 3} for row in part if row["seed"] == 1 and row["K"] != 20]
    few, lines = ({line[0]: line[1:] for line in report.iqm_table(each, "as written")} for each in (part, part + third))
    assert lines["KLE-Stop, d_target = 0.05"][4] == "" and "[" in lines["KLE-Stop, d_target = 0.05"][1]
    assert "[" not in lines["PPO"][2] and float(lines["PPO"][2]) > 0 and "[" not in few["PPO"][1]
    before, after = (report.heat_map(each, "as written").axes[0].images[0].get_array() for each in (rows, part))
    assert not np.ma.is_masked(before[5, 4]) and np.isnan(np.ma.filled(after, np.nan)[5, 4])


def test_each_task_counts_the_same_in_an_interquartile_mean():
    scores = {"a": np.array([0.0, 0.2, 9.0, 9.0]), "b": np.array([0.4, 0.6])}
    assert {task: values.tolist() for task, values in report.even(scores).items()} == {"a": [0.0, 0.2], "b": [0.4, 0.6]}


def test_a_run_that_has_only_begun_is_left_out(study, tmp_path):
    """Its CSV files are there, and empty."""
    shutil.copytree(study, tmp_path / "runs")
    begun = sorted(path for path in (tmp_path / "runs").iterdir() if (path / "updates.csv").exists())[0]
    (begun / "result.json").unlink(missing_ok=True)
    for name in ("updates.csv", "episodes.csv"):
        (begun / name).write_text("")
    before, after = (report.read_runs(folder, 102_400, 1) for folder in (study, tmp_path / "runs"))
    assert len(after) == len(before)
    assert sum("curves" not in run for run in after) == 1 + sum("curves" not in run for run in before)


def test_runs_whose_folders_are_gone_count_on(study, tmp_path):
    report.main(report.Args(runs=study, steps=102_400, out=tmp_path / "whole", workers=1))
    shutil.copytree(study, tmp_path / "runs")
    report.main(report.Args(runs=tmp_path / "runs", steps=102_400, out=tmp_path / "out", workers=1))
    for run in sorted((tmp_path / "runs").glob("*"))[3:]:
        shutil.rmtree(run)
    again = report.Args(runs=tmp_path / "runs", steps=102_400, out=tmp_path / "out", known=tmp_path / "out", workers=1)
    report.main(again)
    for name in ("runs.csv", "tables.tex"):  # the cost is from shorter runs too, which a report does not keep
        kept, whole = ((tmp_path / out / name).read_text().split("Cost of the study")[0] for out in ("out", "whole"))
        assert kept == whole
    whole, kept = (np.load(tmp_path / name / "curves.npz") for name in ("whole", "out"))
    assert whole.files == kept.files and all(np.array_equal(whole[k], kept[k], equal_nan=True) for k in whole.files)
    number = len(whole.files)
    assert f"{number - 3} of the runs are those of an earlier report" in (tmp_path / "out" / "tables.md").read_text()


def test_runs_that_went_on_count_without_their_folders(study, tmp_path):
    """They had no result yet: neither a speed nor the script's checksum."""
    shutil.copytree(study, tmp_path / "runs")
    for path in (tmp_path / "runs").glob("*/result.json"):
        path.unlink()
    report.main(report.Args(runs=tmp_path / "runs", steps=102_400, out=tmp_path / "out", workers=1))
    shutil.rmtree(tmp_path / "runs")
    again = report.Args(runs=tmp_path / "runs", steps=102_400, out=tmp_path / "out", known=tmp_path / "out", workers=1)
    before = (tmp_path / "out" / "runs.csv").read_text()
    report.main(again)
    assert (tmp_path / "out" / "runs.csv").read_text() == before


def test_an_earlier_report_without_curves(study, tmp_path):
    report.main(report.Args(runs=study, steps=102_400, out=tmp_path / "out", workers=1))
    (tmp_path / "out" / "curves.npz").unlink()
    with pytest.raises(UsageError, match="not of 500,000"):
        report.read_known(tmp_path / "out", 500_000)
    runs = report.read_known(tmp_path / "out", 102_400)
    assert not any(run["curves"] for run in runs) and {run["row"]["d_target"] for run in runs} == {"", 0.03, 0.05}
    (tmp_path / "none").mkdir()
    report.main(
        report.Args(runs=tmp_path / "none", steps=102_400, out=tmp_path / "out", known=tmp_path / "out", workers=1)
    )
    assert (tmp_path / "out" / "learning_curves.png").exists()


def test_a_single_task_leaves_a_claim_open():
    """Seeds of one task say nothing of others."""
    found = report.tell("", "", report.minus, {"Hopper": np.array([1.0, 0.9])}, {"Hopper": np.array([0.5, 0.4])})
    assert (found.measured, found.verdict) == ("+0.50, 1 task, 2 seeds", "open")


def test_a_claim_that_holds_in_these_tasks_and_not_in_every_one_tells_both():
    """Seeds are alike, tasks are not: 1 and -0.5."""
    ours = {"a": np.array([1.0, 1.01]), "b": np.array([0.0, 0.01])}
    theirs = {"a": np.array([0.0, 0.01]), "b": np.array([0.5, 0.51])}
    found = report.tell("", "", report.minus, ours, theirs)
    assert found.verdict == "confirmed; over tasks open"
    assert found.measured.startswith("+0.25 [+0.2") and found.over_tasks.startswith("[-")


@pytest.mark.parametrize("setting, stages", [("printed", set()), ("modern", {"--kle-rollback", "--update-epochs 80"})])
def test_the_study_runs_the_settings_of_the_file(setting, stages):
    """Flags of `SETTING=... benchmark/ppo_kle.sh` are those of the file's table, but for what its stages differ in."""
    command = ["env", f"SETTING={setting}", "STAGES=first", "PYTHON=echo", ROOT / "benchmark" / "ppo_kle.sh"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    line = next(line for line in ppo.__doc__.splitlines() if line.startswith(("| as " + setting, "| " + setting)))
    flags = {*re.split(r" (?=--)", line.split("`")[1])}
    used = re.search(r"--checkpoint-interval 200000 (.*) --runs ", told)[1]
    assert {*re.split(r" (?=--)", used)} == flags - stages and f"--runs runs/ppo_kle_{setting} " in told
