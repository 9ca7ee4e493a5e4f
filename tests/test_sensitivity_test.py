"""The study: clips that tell nothing, answers that count once, the table's numbers, and what strangers may not do."""

import contextlib
import csv
import itertools
import json
import math
import os
import random
import shutil
import sqlite3
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import scipy.stats
from conftest import ROOT, assert_refused, edit_manifest, run
from fastapi.testclient import TestClient

from cleanrl_thesis import ddpg_torcs_like as ddpg
from cleanrl_thesis import distill_hybrid as distill
from cleanrl_thesis import sensitivity_test as study

HOME = "http://127.0.0.1:8000"
AGENTS = ("human", "hybrid", "dqn")


def pictures(seed: int, count: int = 12):
    """Noise, whose files differ."""
    rng = np.random.default_rng(seed)
    return (rng.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(count))


@pytest.fixture(scope="session")
def drawn_clips(tmp_path_factory) -> Path:
    """Three agents with three clips each, rules with a quote in them, and a practice clip."""
    folder = tmp_path_factory.mktemp("study") / "videos"
    for seed, (agent, i) in enumerate(itertools.product(AGENTS, range(3))):
        (folder / agent).mkdir(parents=True, exist_ok=True)
        study.write_clip(folder / agent / f"{i:03d}.mp4", pictures(seed), 12)
    study.write_clip(folder / "practice.mp4", pictures(99), 12)
    (folder / "rules.txt").write_text('Take the apple. </script><b>"quoted"</b>')
    return folder


@pytest.fixture
def videos(drawn_clips, tmp_path) -> Path:
    return shutil.copytree(drawn_clips, tmp_path / "videos")


def open_study(videos: Path, **given) -> tuple[TestClient, Path]:
    args = study.complete_args(study.Args(videos=videos, db=videos.parent / "study.sqlite", **given))
    clips = study.find_clips(args.videos, args.clips_per_agent)
    study.open_database(args.db, clips)
    return TestClient(study.make_app(args, clips), base_url=HOME), args.db


def key_of(number: int) -> str:
    return f"{number:032x}"


def take_part(client: TestClient, number: int, judge, twice: bool = False) -> list[tuple[str, str]]:
    """Go through the whole study; returns (address, verdict) of each clip. `judge` is a function of the position."""
    key, given = {"key": key_of(number)}, []
    for _ in range(1 + twice):
        trial = client.post("/join", json={**key, "age": 20 + number, "gender": "another"}).json()
    while not trial["done"]:
        verdict = judge(trial["position"])
        answer = {**key, "address": trial["address"], "verdict": verdict, "why": f"because {trial['position']}"}
        given.append((trial["address"], verdict))
        for _ in range(1 + twice):
            trial = client.post("/answer", json=answer).json()
    return given


def rows(db: Path, query: str) -> list[tuple]:
    connection = sqlite3.connect(db)
    try:
        return connection.execute(query).fetchall()
    finally:
        connection.close()


# ---------------------------------------------------------------------------------------------------------------------
# Clips
# ---------------------------------------------------------------------------------------------------------------------
def test_clips_of_all_agents_begin_at_the_same_moments_of_other_episodes():
    """None overlaps another, or goes beyond its episode; an episode has two only where there is no other."""
    rng, found = np.random.default_rng(0), 0
    for _ in range(200):
        lengths = {
            name: {Path(f"{name}{i}"): int(rng.integers(100, 900)) for i in range(rng.integers(2, 9))} for name in "ab"
        }
        frames, clips = int(rng.integers(20, 200)), int(rng.integers(1, 6))
        cuts = study.common_windows(lengths, frames, clips, rng)
        found += cuts is not None
        for name, windows in (cuts or {}).items():
            assert len(windows) == clips and [start for _, start in windows] == [start for _, start in cuts["a"]]
            assert all(0 <= start <= lengths[name][path] - frames for path, start in windows)
            for (path, start), (other, other_start) in itertools.combinations(windows, 2):
                assert path != other or abs(start - other_start) >= frames
    assert found > 150
    assert study.common_windows({"a": {Path("a"): 99}, "b": {Path("b"): 500}}, 100, 1, rng) is None


def test_moments_of_clips_are_even_and_tell_no_agent():
    """An agent that often ends early has as many late clips as the other; its long episodes are drawn for them."""
    rng = np.random.default_rng(0)
    lengths = {"a": {Path(f"a{i}"): 1_800 for i in range(16)}}
    lengths["b"] = {Path(f"b{i}"): 1_800 if i < 12 else 1_000 for i in range(16)}
    cuts = [study.common_windows(lengths, 900, 4, rng) for _ in range(100)]
    starts = [start for cut in cuts for _, start in cut["b"]]
    assert scipy.stats.kstest(starts, "uniform", (0, 900)).pvalue > 0.001
    early = [start for cut in cuts for path, start in cut["b"] if int(path.name[1:]) >= 12]
    assert 0 < len(early) < len(starts) / 4 and max(early) <= 100


def test_clips_have_the_length_asked_for_and_hold_nothing_else(drawn_clips):
    content = (drawn_clips / "dqn" / "000.mp4").read_bytes()
    assert study.describe_clip(content) == (1.0, 64, 48, 12)
    about = subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", drawn_clips / "dqn" / "000.mp4"], capture_output=True, text=True
    ).stderr
    assert (
        "creation_time" not in about and "title" not in about and "64x48" in about and "Duration: 00:00:01.00" in about
    )
    assert {os.stat(path).st_mtime for path in drawn_clips.rglob("*.mp4")} == {study.CLIP_TIME}
    frames = list(study.read_video(drawn_clips / "dqn" / "000.mp4"))
    assert len(frames) == 12 and frames[0].shape == (48, 64, 3)


def test_equal_pictures_make_equal_files(tmp_path):
    for name in ("a", "b"):
        study.write_clip(tmp_path / f"{name}.mp4", pictures(1), 12)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def tagged(path: Path, *flags: str) -> None:
    """Put metadata into a clip, as other programs do."""
    new = path.with_name("new.mp4")
    subprocess.run(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-c", "copy", *flags, new], check=True, capture_output=True
    )
    os.replace(new, path)


def stretched(path: Path) -> None:
    study.write_clip(path, pictures(1, 14), 12)


def enlarged(path: Path) -> None:
    study.write_clip(path, (np.zeros((64, 64, 3), np.uint8) for _ in range(12)), 12)


def linked(path: Path) -> None:
    shutil.move(path, path.parent.parent.parent / "outside.mp4")
    path.symlink_to(path.parent.parent.parent / "outside.mp4")


def test_agents_on_different_roads_are_refused(tmp_path, capsys):
    for name, track in (("a", "meadow"), ("b", "hills")):
        record_apple(tmp_path / name)
        edit_manifest(tmp_path / name, lambda m: m.update(env_id="TorcsLike-v0", options={"track": track}))  # noqa: B023
    flags = ["--videos", tmp_path / "out", "--prepare", f"a={tmp_path / 'a'}", f"b={tmp_path / 'b'}"]
    assert_refused(study, capsys, flags, ["--prepare", "roads", "hills", "meadow"])


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda p: tagged(p, "-metadata", "title=dqn, seed 1"), ["metadata"]),
        (lambda p: tagged(p, "-fflags", "+bitexact", "-metadata", "creation_time=2020-01-01"), ["tell the agent"]),
        (stretched, ["1.17 s", "1.00 s"]),
        (enlarged, ["64 x 64", "64 x 48"]),
        (lambda p: study.write_clip(p, pictures(1, 24), 24), ["24 frames", "12 frames"]),
        (linked, ["link"]),
        (lambda p: p.write_bytes(p.read_bytes()[:-100]), ["cut off"]),
        (lambda p: p.write_bytes(b"no video"), ["no MP4 video"]),
        (lambda p: p.write_bytes(b""), ["no MP4 video"]),
        (lambda p: (p.unlink(), (p.parent / "001.mp4").unlink()), ["1 *.mp4", "needs 2"]),
        (lambda p: shutil.copy(p.parent / "001.mp4", p), ["the same clip twice"]),
        (lambda p: shutil.rmtree(p.parent.parent), ["no folder"]),
    ],
    ids=["title", "time", "length", "size", "speed", "link", "cut", "text", "empty", "few", "twice", "folder"],
)
def test_clips_that_could_tell_the_agent_are_refused(damage, words, videos, capsys):
    damage(videos / "human" / "002.mp4")
    assert_refused(
        study, capsys, ["--videos", videos, "--db", videos.parent / "s.sqlite", "--port", 0], ["--videos", *words]
    )


def record_apple(folder: Path, count: int = 2) -> Path:
    human = distill.SyntheticHuman(count, 1)
    episodes = distill.play(human, "AppleGame-v0", list(range(count)), keep=True)
    distill.save_episodes(folder, episodes, {"env_id": "AppleGame-v0", "player": "synthetic"})
    return folder


def test_prepare_cuts_recordings_runs_and_videos(tmp_path, capsys):
    """A folder of demonstrations, of which the rest is for practice, and a run that has some; the frames are those of the game."""
    record_apple(tmp_path / "anna", 3)
    (tmp_path / "run").mkdir()
    record_apple(tmp_path / "run" / "demos")
    flags = ["--videos", tmp_path / "out", "--clips", 2, "--seconds", 1, "--prepare"]
    flags += [f"human={tmp_path / 'anna'}", f"dqn={tmp_path / 'run'}", "--practice", tmp_path / "anna"]
    assert study.cli([str(flag) for flag in flags]) == 0
    made = sorted(str(path.relative_to(tmp_path / "out")) for path in (tmp_path / "out").rglob("*") if path.is_file())
    clips = [f"{agent}/00{i}.mp4" for agent in ("dqn", "human") for i in range(2)]
    assert made == sorted([*clips, "practice.mp4", "prepared.json", "rules.txt"])
    prepared = json.loads((tmp_path / "out" / "prepared.json").read_text())
    cut = next(each for each in prepared["clips"] if each["clip"] == "human/000.mp4")
    shown = {each["from"] for each in prepared["clips"] if each["clip"].startswith("human/")}
    (practised,) = (each["from"] for each in prepared["clips"] if each["clip"] == "practice.mp4")
    assert len(shown) == 2 and practised not in shown
    with np.load(tmp_path / "anna" / cut["from"]) as arrays:
        env = distill.make_env("AppleGame-v0", "rgb_array")
        env.reset(seed=int(arrays["seed"]))
        for action in arrays["actions"][: round(cut["second"] * 60) + 1]:
            env.step(action)
    shown = next(study.read_video(tmp_path / "out" / "human" / "000.mp4")).astype(int)
    assert shown.shape == (528, 480, 3) and np.abs(shown - env.render()).mean() < 3
    flags[flags.index("--prepare") + 1 :] = [f"a={tmp_path / 'out' / 'human'}", f"b={tmp_path / 'out' / 'dqn'}"]
    flags[1], flags[5] = tmp_path / "again", 0.5
    assert study.cli([str(flag) for flag in flags]) == 0
    assert study.describe_clip((tmp_path / "again" / "a" / "000.mp4").read_bytes())[0] == 0.5


def test_practice_needs_an_episode_of_its_own(tmp_path, capsys):
    record_apple(tmp_path / "anna")
    flags = ["--videos", tmp_path / "out", "--clips", 2, "--seconds", 1, "--prepare", f"a={tmp_path / 'anna'}"]
    assert_refused(study, capsys, [*flags, "--practice", tmp_path / "anna"], ["--practice", "no episode of 1 s"])
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path, capsys):
    record_apple(tmp_path / "anna")
    (tmp_path / "file").write_text("")
    flags = ["--clips", 2, "--seconds", 1, "--prepare", f"a={tmp_path / 'anna'}"]
    assert_refused(study, capsys, ["--videos", tmp_path / "file" / "out", *flags], ["--videos", "cannot be written"])


def test_an_agents_own_script_is_asked_for_episodes(tmp_path):
    flags = ["--alpha", "0", "--epochs", "1", "--demo-frames", "1800", "--test-frames", "100", "--eval-episodes", "1"]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=ROOT / "cleanrl_thesis" / "distill_hybrid.py")
    before = (tmp_path / "run" / "updates.csv").read_bytes()
    prepare = ["--videos", tmp_path / "out", "--clips", 1, "--seconds", 1, "--prepare", f"bc={tmp_path / 'run'}"]
    assert study.cli([str(flag) for flag in prepare]) == 0
    assert (tmp_path / "out" / "bc" / "000.mp4").exists() and (tmp_path / "run" / "updates.csv").read_bytes() == before


def test_gophers_agents_are_drawn_at_sixty_frames_a_second():
    """An agent's actions of 4 frames give 4 pictures each, the last of which is what the agent's own game shows."""
    game = study.load_method("dqn_gopher").make_atari("ALE/Gopher-v5")
    game.reset(seed=5)
    actions, rewards, shown = [1, 3, 6, 4, 1] * 20, [], []
    for action in actions:
        rewards.append(game.step(action)[1])
        shown.append(game.render().copy())
    episode = {"seed": np.array(5), "actions": np.array(actions), "rewards": np.array(rewards)}
    drawn = list(study.draw_episode("ALE/Gopher-v5", {"frame_skip": 4, "noop_max": 30}, episode))
    assert len(drawn) == 400 and all(np.array_equal(drawn[4 * i + 3][::3, ::3], image) for i, image in enumerate(shown))
    episode["rewards"][50] += 1
    with pytest.raises(study.UsageError, match="other rewards"):
        list(study.draw_episode("ALE/Gopher-v5", {"frame_skip": 4, "noop_max": 30}, episode))


def test_driving_is_drawn(tmp_path):
    env = ddpg.make_env("TorcsLike-v0", "rgb_array", track="hills")
    env.reset(seed=3)
    actions = np.tile(np.array([[0.0, 0.5]], np.float32), (20, 1))
    episode = {"seed": np.array(3), "actions": actions, "rewards": np.array([env.step(a)[1] for a in actions])}
    frames = list(study.draw_episode("TorcsLike-v0", {"track": "hills", "reward": "distance", "brake": True}, episode))
    assert len(frames) == 20 and np.array_equal(frames[-1], env.render())


@pytest.mark.parametrize(
    "flags, words",
    [
        (["a=anna", "b=nowhere"], ["--prepare", "nowhere", "no folder"]),
        (["a=anna", "b=empty"], ["--prepare", "empty", "no demonstrations"]),
        (["a=anna", "practice=anna"], ["--prepare", "practice"]),
        (["a=anna", "--seconds", 0.001], ["--seconds", "0.001", "1/60"]),
        (["a=anna", "--clips", 99], ["--prepare", "a=anna", "needs 99"]),
        (["a=anna", "--seconds", 31], ["a=anna", "0 clips of 31 s"]),
        (["a=anna", "--seconds", 0], ["--seconds", "0.0"]),
        (["a=anna", "a=anna"], ["--prepare", "twice"]),
        (["../a=anna"], ["--prepare", "../a=anna", "NAME=FOLDER"]),
        (["anna"], ["--prepare", "NAME=FOLDER"]),
        (["a=damaged"], ["episode_00000.npz", "SHA-256"]),
        (["a=unfinished"], ["unfinished", "not done"]),
        (["a=anna", "--export", "results"], ["--prepare", "--export", "exclude each other"]),
    ],
)
def test_what_cannot_be_cut_is_refused_and_leaves_nothing(flags, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    record_apple(Path("anna"))
    shutil.copytree("anna", "damaged")
    Path("damaged/episode_00000.npz").write_bytes(b"x")
    Path("unfinished").mkdir()
    Path("empty").mkdir()
    Path("unfinished/args.json").write_text('{"exp_name": "dqn_apple"}')
    assert_refused(study, capsys, ["--videos", "out", "--prepare", *flags], words)
    assert sorted(os.listdir()) == ["anna", "damaged", "empty", "unfinished"]


# ---------------------------------------------------------------------------------------------------------------------
# Answers
# ---------------------------------------------------------------------------------------------------------------------
def test_everyone_sees_two_clips_of_each_agent_in_an_order_of_their_own(videos):
    client, db = open_study(videos)
    for number in range(30):
        client.post("/join", json={"key": key_of(number)})
    seen = rows(
        db, "SELECT participant, agent, trials.clip, address FROM trials JOIN clips USING (clip) ORDER BY 1, position"
    )
    orders = [tuple(agent for _, agent, _, _ in seen[i : i + 6]) for i in range(0, 180, 6)]
    assert all(sorted(order) == sorted(2 * AGENTS) for order in orders) and len(set(orders)) > 15
    counts = [sum(clip == other for _, _, other, _ in seen) for clip in {clip for _, _, clip, _ in seen}]
    assert len(counts) == 9 and max(counts) - min(counts) <= 1  # those that were seen least come first
    assert len({address for *_, address in seen}) == 180


def test_clips_with_the_fewest_answers_come_first(videos):
    """Whoever leaves without an answer takes nothing from a clip."""
    client, db = open_study(videos)
    for number in range(30):
        client.post("/join", json={"key": key_of(number)})
    chosen = {agent: clip for clip, agent in rows(db, "SELECT clip, agent FROM clips")}
    with contextlib.closing(sqlite3.connect(db)) as base, base:
        base.execute("UPDATE trials SET verdict = 'human'")
        base.executemany("UPDATE trials SET verdict = NULL WHERE clip = ?", [(clip,) for clip in chosen.values()])
    client.post("/join", json={"key": key_of(99)})
    drawn = {clip for (clip,) in rows(db, "SELECT clip FROM trials WHERE participant = 31")}
    assert set(chosen.values()) < drawn


def test_nothing_that_is_sent_tells_the_agent(videos):
    """Names of agents and files are in no page, answer, address or header; a clip's headers differ in length alone."""
    client, _ = open_study(videos)
    sent, headers = [client.get("/").text], []
    trial = client.post("/join", json={"key": key_of(1)}).json()
    while not trial["done"]:
        clip = client.get(f"/clip/{trial['address']}")
        assert clip.status_code == 200 and clip.headers["content-type"] == "video/mp4"
        assert any(path.read_bytes() == clip.content for path in videos.rglob("*.mp4"))
        headers.append({name: value for name, value in clip.headers.items() if name != "content-length"})
        sent += [json.dumps(trial), str(clip.headers)]
        answer = {"key": key_of(1), "address": trial["address"], "verdict": "human"}
        trial = client.post("/answer", json=answer).json()
    assert all(each == headers[0] for each in headers) and not {"etag", "last-modified"} & headers[0].keys()
    text = "\n".join(sent)
    assert "dqn" not in text and "hybrid" not in text and "000.mp4" not in text


def test_a_reload_or_a_double_click_changes_nothing(videos):
    client, db = open_study(videos)
    given = take_part(client, 1, lambda position: "human" if position % 2 else "machine", twice=True)
    assert len(given) == 6 and rows(db, "SELECT COUNT(*) FROM participants") == [(1,)]
    other = {"key": key_of(1), "address": given[0][0], "verdict": "human", "why": "changed my mind"}
    assert client.post("/answer", json=other).json() == {"done": True, "total": 6}
    assert rows(db, "SELECT address, verdict FROM trials ORDER BY position") == given
    assert rows(db, "SELECT why FROM trials WHERE position = 0") == [("because 0",)]


def test_answers_to_clips_that_are_not_shown_are_refused(videos):
    client, db = open_study(videos)
    client.post("/join", json={"key": key_of(1)})
    client.post("/join", json={"key": key_of(2)})
    addresses = rows(db, "SELECT participant, address FROM trials ORDER BY participant, position")
    for key, address in ((1, addresses[1][1]), (1, addresses[6][1]), (1, "nowhere"), (3, addresses[0][1])):
        answer = {"key": key_of(key), "address": address, "verdict": "human"}
        assert client.post("/answer", json=answer).status_code == 409
    assert client.post("/next", json={"key": key_of(3)}).status_code == 404
    assert rows(db, "SELECT COUNT(verdict) FROM trials") == [(0,)]


@pytest.mark.parametrize(
    "path, body",
    [
        ("/join", {"key": "short"}),
        ("/join", {"key": key_of(1), "age": 0}),
        ("/join", {"key": key_of(1), "age": 1.5}),
        ("/join", {"key": key_of(1), "gender": "x' OR 1 --"}),
        ("/next", {"key": "' OR '1'='1"}),
        ("/answer", {"key": key_of(1), "address": "x", "verdict": "dog"}),
        ("/answer", {"key": key_of(1), "address": "x", "verdict": "human", "why": "x" * 2_001}),
        ("/answer", {"key": key_of(1), "address": ["x"], "verdict": "human"}),
        ("/join", []),
        ("/answer", b'{"key": "' + key_of(1).encode() + b'", "address": "x", "verdict": "human", "why": "\\ud800"}'),
        ("/join", b'{"key": "' + key_of(1).encode() + b'", "age": NaN}'),
        ("/join", b"no json"),
    ],
)
def test_what_is_not_understood_is_refused(path, body, videos):
    client, db = open_study(videos)
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    answer = client.post(path, content=content, headers={"content-type": "application/json"})
    assert answer.status_code == 422
    assert rows(db, "SELECT COUNT(*) FROM participants") == [(0,)]


def test_many_at_once(videos):
    """26 participants in 8 threads, everything sent twice: each answer is there once, as it was given."""
    client, db = open_study(videos)
    rng = random.Random(1)
    plans = {number: [rng.choice(["human", "machine"]) for _ in range(6)] for number in range(26)}
    with ThreadPoolExecutor(8) as pool:
        given = list(pool.map(lambda number: take_part(client, number, plans[number].__getitem__, twice=True), plans))
    stored = rows(db, "SELECT key, verdict FROM trials JOIN participants USING (participant) ORDER BY key, position")
    assert stored == [(key_of(number), verdict) for number in plans for verdict in plans[number]]
    assert dict(itertools.chain(*given)) == dict(rows(db, "SELECT address, verdict FROM trials"))


def test_the_study_goes_on_with_its_clips(videos, capsys):
    """Opened again it is the same study; with a clip changed or gone it is refused, and another clip is taken in."""
    client, db = open_study(videos)
    take_part(client, 1, lambda position: "human")
    study.write_clip(videos / "human" / "003.mp4", pictures(77), 12)
    client, _ = open_study(videos)
    assert client.post("/next", json={"key": key_of(1)}).json() == {"done": True, "total": 6}
    assert rows(db, "SELECT COUNT(*) FROM clips") == [(10,)]
    study.write_clip(videos / "human" / "000.mp4", pictures(78), 12)
    assert_refused(study, capsys, ["--videos", videos, "--db", db, "--port", 0], ["--videos", "have changed"])
    (videos.parent / "text").write_text("no database")
    flags = ["--videos", videos, "--db", videos.parent / "text", "--port", 0]
    assert_refused(study, capsys, flags, ["--db", "not a database"])


def test_one_server_for_one_study(videos, capsys):
    """A second one, with another clip, would draw it for participants of the first, which does not have it."""
    db = videos.parent / "study.sqlite"
    study.lock_database(db)
    study.write_clip(videos / "human" / "003.mp4", pictures(77), 12)
    assert_refused(study, capsys, ["--videos", videos, "--db", db, "--port", 0], ["--db", "another study is running"])
    assert db.read_bytes() == b""


def test_a_clip_that_is_gone_is_asked_for_again(videos, capsys):
    client, _ = open_study(videos)
    address = client.post("/join", json={"key": key_of(1)}).json()["address"]
    for path in videos.glob("*/*.mp4"):
        path.rename(path.with_suffix(".away"))
    answer = client.get(f"/clip/{address}")
    assert (answer.status_code, answer.json()) == (503, {"detail": "cannot be read"})
    err = capsys.readouterr().err
    assert "No such file" in err and not any(agent in err for agent in AGENTS)  # whoever leads the study reads it
    for path in videos.glob("*/*.away"):
        path.rename(path.with_suffix(".mp4"))
    assert client.get(f"/clip/{address}").status_code == 200


# ---------------------------------------------------------------------------------------------------------------------
# Export
# ---------------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("people, share", [(1, 0), (5, 0), (26, 0), (26, 1), (3, 1)])
def test_interval_of_one_and_the_same_answer_is_wilsons_for_the_participants(people, share):
    judged = np.full(people, 2)
    expected = scipy.stats.binomtest(share * people, people).proportion_ci(0.95, "wilson")
    assert study.interval(share * judged, judged) == pytest.approx(tuple(expected), abs=1e-9)


@pytest.mark.parametrize(
    "human, judged, effective",
    [
        ([0, 2, 2, 0, 2], [2] * 5, 5),  # who says it once says it always: an answer each
        ([1] * 8, [2] * 8, 16),  # each once: as if all were independent
        ([0, 1, 0, 0, 1, 1], [1] * 6, 6),
        ([3, 0, 1], [3, 1, 2], 6 / 1.75),  # by hand: squares of 14/9, times 3/2 / 36, to 2/9 / 6
    ],
)
def test_interval_is_wilsons_for_the_effective_number_of_answers(human, judged, effective):
    """Against the equation whose two roots are the interval's ends: (p - share)^2 = z^2 p (1 - p) / n."""
    share = sum(human) / sum(judged)
    for end in study.interval(np.array(human), np.array(judged)):
        z2 = effective * (end - share) ** 2 / (end * (1 - end))
        assert math.sqrt(z2) == pytest.approx(scipy.stats.norm.ppf(0.975), rel=1e-6)


def test_the_design_effect_is_that_of_participants_shares():
    """With as many clips for each, the variance is that of the mean of their shares, by SciPy."""
    human, answers = np.random.default_rng(1).choice(3, p=(0.4, 0.3, 0.3), size=26), 52
    share, error = human.sum() / answers, scipy.stats.sem(human / 2)
    low, high = study.interval(human, np.full(26, 2))
    z2 = (low - share) ** 2 / (low * (1 - low))
    assert math.sqrt(z2 * share * (1 - share)) == pytest.approx(1.959964 * error, rel=1e-5)
    assert 1 < error**2 * answers / (share * (1 - share)) < 2 and low < share < high


@pytest.mark.parametrize("share", [0.02, 0.08, 0.3, 0.96])
@pytest.mark.parametrize("alike", [0.0, 0.5])
def test_intervals_hold_the_truth_19_times_in_20(share, alike):
    """26 participants with two clips each, whose second answer repeats the first with a given probability."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(2_000):
        first, other = rng.random((2, 26)) < share
        human = first + np.where(rng.random(26) < alike, first, other).astype(int)
        low, high = study.interval(human, np.full(26, 2))
        held += low <= share <= high
    assert 0.935 < held / 2_000 < 0.985


def test_export_counts_as_by_hand(videos, tmp_path, capsys):
    """Verdicts that follow from the agent: of human 5 in 8, of dqn none; one who stopped early counts for what was said."""
    client, db = open_study(videos)
    agents = {}
    for number in range(4):
        client.post("/join", json={"key": key_of(number)})
        query = "SELECT agent FROM trials JOIN clips USING (clip) JOIN participants USING (participant) WHERE key = '{}' ORDER BY position"
        agents[number] = [agent for (agent,) in rows(db, query.format(key_of(number)))]
    counts = {agent: [0, 0] for agent in AGENTS}
    for number in range(4):
        trial = client.post("/next", json={"key": key_of(number)}).json()
        for position in range(4 if number == 3 else 6):
            agent = agents[number][position]
            verdict = "human" if agent == "human" or (agent == "hybrid" and (number + position) % 2) else "machine"
            counts[agent][0] += verdict == "human"
            counts[agent][1] += 1
            answer = {"key": key_of(number), "address": trial["address"], "verdict": verdict}
            trial = client.post("/answer", json=answer).json()
    assert study.cli(["--db", str(db), "--export", str(tmp_path / "results")]) == 0
    with open(tmp_path / "results" / "identified_as_human.csv") as file:
        table = {row["agent"]: row for row in csv.DictReader(file)}
    assert {a: [int(table[a]["identified_as_human"]), int(table[a]["judged"])] for a in AGENTS} == counts
    assert float(table["dqn"]["low"]) == 0 and 0 < float(table["dqn"]["high"]) < 1
    assert float(table["human"]["high"]) == 1 and "0 of" in capsys.readouterr().out


def test_what_is_exported_names_nobody(videos, tmp_path):
    """Participants are numbered in another order than they came, and ages stand in a file of their own, in another order too."""
    client, db = open_study(videos)
    for number in range(20):
        take_part(client, number, lambda position: "human")
    ages = [str(20 + number) for number in range(20)]
    orders = []
    for folder in ("one", "two"):
        assert study.cli(["--db", str(db), "--export", str(tmp_path / folder)]) == 0
        with open(tmp_path / folder / "participants.csv", newline="") as file:
            orders.append([row["age"] for row in csv.DictReader(file)])
        with open(tmp_path / folder / "comments.csv", newline="") as file:
            written = list(csv.DictReader(file))
        assert sorted({int(row["participant"]) for row in written}) == list(range(1, 21)) and len(written) == 120
        own = rows(db, "SELECT file, agent FROM trials JOIN clips USING (clip) WHERE participant = 1 ORDER BY position")
        seen = {n: [(r["clip"], r["agent"]) for r in written if int(r["participant"]) == n] for n in range(1, 21)}
        orders.append([n for n in seen if seen[n] == own])
    assert sorted(orders[0]) == sorted(orders[2]) == ages and orders[0] != ages and orders[0] != orders[2]
    assert all(len(order) >= 1 for order in orders[1::2])


def test_comments_stay_text_and_no_formula(videos, tmp_path):
    comments = [
        '=HYPERLINK("http://evil.example";"x")',
        "+1+cmd|' /C calc'!A0",
        "'); DROP TABLE trials; --",
        "<script>alert(1)</script>",
        "\t=1",
        'two\nlines, "quoted", ü 漢',
    ]
    client, db = open_study(videos)
    trial = client.post("/join", json={"key": key_of(1)}).json()
    for comment in comments:
        answer = {"key": key_of(1), "address": trial["address"], "verdict": "human", "why": comment}
        trial = client.post("/answer", json=answer).json()
    assert [why for (why,) in rows(db, "SELECT why FROM trials ORDER BY position")] == comments
    assert study.cli(["--db", str(db), "--export", str(tmp_path)]) == 0
    assert study.cli(["--db", str(db), "--export", str(db / "results")]) == 2  # no folder can be in a file
    with open(tmp_path / "comments.csv", newline="") as file:
        comment_rows = list(csv.DictReader(file))
    found = [row["comment"] for row in comment_rows]
    assert list(comment_rows[0]) == ["participant", "agent", "verdict", "position", "clip", "comment"]
    assert found == [
        "'" + comments[0],
        "'" + comments[1],
        "'); DROP TABLE trials;' --",
        comments[3],
        "'\t'=1",
        comments[5],
    ]
    for text in ("-1", "@x", "  =1", "\rx", "\nx", "\uff1d1"):
        assert study.guarded(text) == "'" + text
    assert study.guarded("nice; =1+1") == "nice;' =1+1" and study.guarded("a\n=1") == "a\n'=1"
    assert study.guarded("a = b") == "a = b" and study.guarded(None) == ""


# ---------------------------------------------------------------------------------------------------------------------
# Strangers
# ---------------------------------------------------------------------------------------------------------------------
def test_it_listens_on_this_machine_unless_told_otherwise():
    assert study.Args().host == "127.0.0.1"
    with contextlib.closing(study.listen(study.Args().host, 0)) as listener:
        address, port = listener.getsockname()
        assert address == "127.0.0.1"
        with pytest.raises(study.UsageError, match="cannot be listened on"):
            study.listen("127.0.0.1", port)
    assert study.allowed_hosts("0.0.0.0") is None
    assert "mylab.local" in study.allowed_hosts("MyLab.local")


@pytest.mark.parametrize(
    "path",
    [
        "/clip/%2e%2e",
        "/clip/../human/000.mp4",
        "/clip/..%2f..%2fstudy.sqlite",
        "/clip/%2e%2e%2f%2e%2e%2fstudy.sqlite",
        "/clip/human%2F000.mp4",
        "/clip//etc/passwd",
        "/clip/' OR 1=1 --",
        "/human/000.mp4",
        "/prepared.json",
        "/docs",
        "/openapi.json",
    ],
)
def test_no_path_leaves_the_clips(path, videos):
    client, _ = open_study(videos)
    client.post("/join", json={"key": key_of(1)})
    assert client.get(path).status_code == 404


def test_requests_are_bounded_and_hosts_known(videos):
    client, _ = open_study(videos)
    assert client.post("/join", content=b"x" * 20_000).status_code == 413
    assert client.post("/join", content=iter([b"x" * 10] * 10)).status_code == 411
    assert client.get("/", headers={"host": "evil.example"}).status_code == 421
    assert client.post("/join", json={"key": key_of(1)}, headers={"origin": "http://evil.example"}).status_code == 403
    assert client.post("/join", json={"key": key_of(1)}, headers={"host": "evil.example"}).status_code == 421
    open_client, _ = open_study(videos, host="0.0.0.0")
    assert open_client.get("/", headers={"host": "lab.example"}).status_code == 200


def test_the_page_is_guarded(videos):
    client, _ = open_study(videos, contact="</script><script>alert(1)</script>")
    page = client.get("/")
    assert "</script><script>alert(1)" not in page.text and '</script><b>"quoted"' not in page.text
    policy = page.headers["content-security-policy"]
    assert (
        "default-src 'none'" in policy
        and "unsafe" not in policy
        and page.headers["x-content-type-options"] == "nosniff"
    )


@pytest.mark.parametrize("asked, code, part", [("bytes=0-", 206, slice(0, None)), ("bytes=10-19", 206, slice(10, 20))])
def test_parts_of_clips(asked, code, part, videos):
    client, _ = open_study(videos)
    trial = client.post("/join", json={"key": key_of(1)}).json()
    whole = client.get(f"/clip/{trial['address']}").content
    answer = client.get(f"/clip/{trial['address']}", headers={"range": asked})
    assert answer.status_code == code and answer.content == whole[part]
    assert answer.headers["content-range"].endswith(f"/{len(whole)}")
    beyond = client.get(f"/clip/{trial['address']}", headers={"range": f"bytes={len(whole)}-"})
    assert beyond.status_code == 416
    assert client.get("/practice.mp4").status_code == 200


@pytest.mark.parametrize(
    "flags, words",
    [
        ([], ["--videos", "needed"]),
        (["--videos", "nowhere"], ["--videos", "nowhere", "no folder"]),
        (["--videos", "x", "--port", -1], ["--port", "-1"]),
        (["--videos", "x", "--clips", 0], ["--clips", "0"]),
        (["--videos", "x", "--clips-per-agent", 0], ["--clips-per-agent", "0"]),
        (["--videos", "x", "--consent", "nowhere"], ["--consent", "nowhere"]),
        (["--videos", "x", "--practice", "y"], ["--practice", "--prepare"]),
        (["--export", "results"], ["--db", "study.sqlite", "no file"]),
        (["--no-such-flag"], ["--no-such-flag"]),
    ],
)
def test_a_wrong_value_is_one_line_and_creates_nothing(flags, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(study, capsys, flags, words)
    assert not list(tmp_path.iterdir())


def test_an_export_without_answers_is_refused(videos, tmp_path, capsys):
    _, db = open_study(videos)
    assert_refused(study, capsys, ["--db", db, "--export", tmp_path / "results"], ["--db", "no answers"])
    assert not (tmp_path / "results").exists()
