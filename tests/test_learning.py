"""The agent learns: a stated return on a small budget."""

import json

import pytest
from conftest import ROOT, SCRIPT, run

pytestmark = pytest.mark.slow


DDPG, GAIL = ROOT / "cleanrl_thesis" / "ddpg_torcs_like.py", ROOT / "cleanrl_thesis" / "gail_hybrid.py"
ROOMS = ROOT / "cleanrl_thesis" / "ppo_fourrooms.py"


def evaluation(folder, *flags, script=SCRIPT) -> float:
    run(*flags, "--compile", "--eval-episodes", 20, "--run-dir", "run", cwd=folder, script=script)
    return json.loads((folder / "run" / "evaluation.json").read_text())["mean"]


def test_inverted_pendulum_stands(tmp_path):
    """The most that an episode can give is 1,000."""
    assert evaluation(tmp_path, "--env-id", "kle/InvertedPendulum-v2", "--total-timesteps", 100_000) > 900


@pytest.mark.parametrize("mode", [[], ["--kle-rollback"]], ids=["ppo", "kle-rollback"])
def test_hopper_hops(tmp_path, mode):
    """A policy that falls at once gets about 20, one that stands still 1,000."""
    assert evaluation(tmp_path, "--env-id", "kle/Hopper-v2", "--total-timesteps", 500_000, *mode) > 1500


def test_pendulum_swings_up_in_the_modern_setting(tmp_path):
    """Random play gets about -1,200; time-outs are bootstrapped, eight environments share the batch."""
    flags = ["--kle-rollback", "--update-epochs", 80, "--bootstrap-truncated", "--kl-estimator", "exact-old-new"]
    flags += ["--kl-samples", "batch", "--kl-timing", "after-iteration", "--rollback", "policy-moments"]
    flags += ["--num-envs", 8, "--gamma", 0.9, "--learning-rate", 1e-3]
    assert evaluation(tmp_path, "--env-id", "Pendulum-v1", "--total-timesteps", 300_000, *flags) > -400


def test_ddpg_swings_a_pendulum_up(tmp_path):
    """Random play gets about -1,200."""
    flags = ["--env-id", "Pendulum-v1", "--total-timesteps", 40_000, "--num-envs", 1, "--frame-skip", 1]
    assert evaluation(tmp_path, *flags, script=DDPG) > -300


def test_ddpg_drives_past_the_first_parked_cars(tmp_path):
    """A car that keeps straight on crashes after 100 m, one that follows the road after 300 m at most."""
    assert evaluation(tmp_path, "--total-timesteps", 400_000, script=DDPG) > 320


def test_gail_drives_like_the_synthetic_human(tmp_path):
    """From its demonstrations alone, without the start by cloning: at first the car comes 50 m far."""
    flags = ["--alpha", 0, "--bc-epochs", 0, "--no-anneal-kl", "--total-timesteps", 2_000_000]
    flags += ["--eval-episodes", 20, "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=GAIL)
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    human, student = (
        part["driving"]["score"]["mean"] for part in (result["experts"]["human"], result["evaluation"]["sampled"])
    )
    assert student > 0.65 * human


def test_ppo_finds_its_way_through_four_rooms(tmp_path):
    """Return of the last 500 episodes of training; random play gets 0.024, the shortest paths 0.900."""
    run("--stop-at", 500_000, "--eval-episodes", 20, "--run-dir", "run", cwd=tmp_path, script=ROOMS)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["training"]["mean"] > 0.4
