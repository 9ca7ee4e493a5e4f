"""A wrong value of a flag: one line that names it, exit code 2, and nothing is made. PPO's are in test_command_line.py."""

import pytest
from conftest import ROOT, assert_refused, run

from cleanrl_thesis import ddpg_torcs_like as ddpg
from cleanrl_thesis import distill_hybrid as distill
from cleanrl_thesis import dqn_apple as dqn
from cleanrl_thesis import dqn_gopher as gopher
from cleanrl_thesis import dreamer_v2 as dreamer
from cleanrl_thesis import gail_hybrid as gail
from cleanrl_thesis import hwm_dreamer, hwm_hrl_dreamer
from cleanrl_thesis import hwm_segment as hwm
from cleanrl_thesis import ppo_fourrooms as rooms

BAD_DQN = [
    (["--env-id", "Pendulum-v1"], ["--env-id", "Pendulum-v1", "Discrete"]),
    (["--env-id", "NoSuchGame-v0"], ["NoSuchGame"]),
    (["--total-timesteps", 3, "--num-envs", 4], ["--total-timesteps", "4 frames"]),
    (["--batch-size", 64, "--buffer-size", 32], ["--batch-size", "64", "32"]),
    (["--buffer-size", 10**12], ["--buffer-size", "1000000000000", "GB"]),
    (["--total-timesteps", 900], ["--learning-starts", "1000", "--total-timesteps, 900"]),
    (["--env-id", "ALE/Gopher-v5"], ["--env-id", "ALE/Gopher-v5", "dqn_gopher.py"]),
    (["--end-e", "2"], ["--end-e", "2.0", "between 0 and 1"]),
    (["--gamma", "nan"], ["--gamma", "nan"]),
    (["--train-frequency", 0], ["--train-frequency", "0"]),
    (["--n-step", 0], ["--n-step", "0"]),
    (["--learning-rate", "-1"], ["--learning-rate"]),
    (["--no-such-flag"], ["--no-such-flag"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_GOPHER = [
    (["--env-id", "CartPole-v1"], ["--env-id", "CartPole-v1", "ALE/*-v5"]),
    (["--env-id", "ALE/NoSuchGame-v5"], ["--env-id", "NoSuchGame"]),
    (["--num-threads", 0], ["--num-threads", "0", "between 1 and 1024"]),
    (["--obs-type", "sound"], ["--obs-type", "sound"]),
    (["--total-timesteps", 31], ["--total-timesteps", "31", "32 frames"]),
    (["--buffer-size", 47], ["--buffer-size", "47", "48"]),
    (["--buffer-size", 10**12, "--total-timesteps", 10**12], ["--buffer-size", "1000000000000", "GB"]),
    (["--total-timesteps", 30_000], ["--learning-starts", "40000", "--total-timesteps, 30000"]),
    (["--hidden-size", 33], ["--hidden-size", "33", "even"]),
    (["--frame-stack", 256], ["--frame-stack", "256", "255"]),
    (["--noop-max", "-1"], ["--noop-max", "-1"]),
    (["--eval-epsilon", 2], ["--eval-epsilon", "2.0", "between 0 and 1"]),
    (["--gamma", "nan"], ["--gamma", "nan"]),
    (["--train-frequency", 0], ["--train-frequency", "0"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_DISTILL = [
    (["--alpha", 0.5], ["--alpha", "0.5", "--teacher"]),
    (["--alpha", 1.5], ["--alpha", "1.5", "between 0 and 1"]),
    (["--alpha", "nan"], ["--alpha", "nan"]),
    (["--alpha", 0, "--temperature", -1], ["--temperature", "-1.0"]),
    (["--alpha", 0, "--dropout", 1], ["--dropout", "1.0", "less than 1"]),
    (["--alpha", 0, "--test-frames", 16_000], ["--test-frames", "16000"]),
    (["--alpha", 0, "--env-id", "CartPole-v1"], ["--env-id", "CartPole-v1", "--demos"]),
    (["--alpha", 0, "--states", "mine"], ["--states", "mine"]),
    (["--alpha", 0, "--states", "own"], ["--states", "own", "--teacher"]),
    (["--alpha", 0, "--split", "episode", "--demo-frames", 1800], ["--split", "episode", "no episode to train on"]),
    (["--teacher", "no/such/folder"], ["--teacher", "no/such/folder", "model.safetensors"]),
    (["--alpha", 0, "--demos", "no/such/folder"], ["--demos", "no/such/folder", "manifest"]),
]
BAD_DDPG = [
    (["--env-id", "CartPole-v1"], ["--env-id", "CartPole-v1", "Box actions"]),
    (["--env-id", "NoSuchTask-v0"], ["NoSuchTask"]),
    (["--track-name", "monza"], ["--track-name", "monza", "meadow"]),
    (["--rollout-steps", 15], ["--rollout-steps", "15", "multiple", "50"]),
    (["--total-timesteps", 50], ["--total-timesteps", "50", "100"]),
    (["--batch-size", 64, "--buffer-size", 32], ["--batch-size", "64", "32"]),
    (["--buffer-size", 10**12], ["--buffer-size", "1000000000000", "GB"]),
    (["--tau", 2], ["--tau", "2.0", "between 0 and 1"]),
    (["--gamma", "nan"], ["--gamma", "nan"]),
    (["--noise", "pink"], ["--noise", "pink"]),
    (["--noise-std", -1], ["--noise-std", "-1.0"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_GAIL = [
    (["--alpha", 0.5], ["--alpha", "0.5", "--demos-rl"]),
    (["--alpha", 1.5], ["--alpha", "1.5", "between 0 and 1"]),
    (["--alpha", 0, "--env-id", "Pendulum-v1"], ["--env-id", "Pendulum-v1", "--demos-human"]),
    (["--alpha", 0, "--max-kl", 0], ["--max-kl", "0.0"]),
    (["--alpha", 0, "--num-steps", 1], ["--num-steps", "1"]),
    (["--alpha", 0, "--frame-skip", 0], ["--frame-skip", "0", "at least 1"]),
    (["--alpha", 0, "--d-grad-penalty", "nan"], ["--d-grad-penalty", "nan"]),
    (["--alpha", 0, "--num-envs", 1, "--num-steps", 8, "--d-steps", 9], ["--d-steps", "9", "8"]),
    (["--alpha", 0, "--total-timesteps", 100], ["--total-timesteps", "100", "5120"]),
    (["--alpha", 0, "--bc-epochs", 0, "--total-timesteps", 0], ["--total-timesteps", "0", "--bc-epochs"]),
    (["--alpha", 0, "--reward-form", "odd"], ["--reward-form", "odd"]),
    (["--alpha", 1, "--demos-rl", "no/such/folder"], ["--demos-rl", "no/such/folder", "manifest"]),
    (["--alpha", 0, "--demos-human", "no/such/folder"], ["--demos-human", "no/such/folder", "manifest"]),
]
BAD_ROOMS = [
    (["--env-id", "MiniGrid-FourRooms-v0"], ["--env-id", "MiniGrid-FourRooms-v0", "FourRooms11-v0"]),
    (["--frame-side", 21], ["--frame-side", "21", "even"]),
    (["--frame-side", 256], ["--frame-side", "256", "128"]),
    (["--num-minibatches", 7], ["--num-minibatches", "7", "divide"]),
    (["--num-envs", 1, "--num-steps", 1, "--num-minibatches", 1], ["--num-envs", "1", "at least 2"]),
    (["--total-timesteps", 100], ["--total-timesteps", "100", "16384"]),
    (["--demo-mode", "best"], ["--demo-mode", "best"]),
    (["--demo-noise", 1.5], ["--demo-noise", "1.5", "between 0 and 1"]),
    (["--ent-coef", "-1"], ["--ent-coef", "-1.0"]),
    (["--gamma", "nan"], ["--gamma", "nan"]),
    (["--eval-episodes", 0], ["--eval-episodes", "0"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_HWM = [
    (["--seed", 2], ["--demos", "ppo_fourrooms.py --save-demos 2300"]),
    (["--demos", "no/such/folder"], ["--demos", "no/such/folder", "manifest"]),
    (["--demos", "x", "--budget", 1.5], ["--budget", "1.5", "between 0 and 1"]),
    (["--demos", "x", "--temperature", 0], ["--temperature", "0.0"]),
    (["--demos", "x", "--frame-side", 65], ["--frame-side", "65", "64"]),
    (["--demos", "x", "--chunk-length", 1], ["--chunk-length", "1", "at least 2"]),
    (["--demos", "x", "--stoch-w", 0], ["--stoch-w", "0"]),
    (["--demos", "x", "--kl-w-scale", "inf"], ["--kl-w-scale", "inf"]),
    (["--demos", "x", "--image-scale", "nan"], ["--image-scale", "nan"]),
    (["--demos", "x", "--no-such-flag"], ["--no-such-flag"]),
    (["--demos", "x", "--resume"], ["--resume", "--run-dir"]),
]
BAD_DREAMER = [
    (["--env-id", "MiniGrid-FourRooms-v0"], ["--env-id", "MiniGrid-FourRooms-v0", "FourRooms11-v0"]),
    (["--size", "huge"], ["--size", "huge", "thesis"]),
    (["--encoder", "cnn", "--frame-side", 22], ["--frame-side", "22", "64", "--encoder cnn"]),
    (["--kl-warmup", 0], ["--entropy-scale", "0.3", "--kl-warmup"]),
    (["--frame-side", 21], ["--frame-side", "21", "even"]),
    (["--num-envs", 7], ["--num-envs", "7", "divide 500"]),
    (["--prefill", 750], ["--prefill", "750", "500"]),
    (["--prefill", 500, "--chunk-length", 50], ["--prefill", "500", "--chunk-length"]),
    (["--total-timesteps", 50_000], ["--prefill", "50000", "--total-timesteps 50000"]),
    (["--total-timesteps", 750], ["--total-timesteps", "750", "multiple of 500"]),
    (["--total-timesteps", 10**15], ["--total-timesteps", "1000000000000000", "GB"]),
    (["--classes", 1], ["--classes", "1", "at least 2"]),
    (["--ent-coef", "-1"], ["--ent-coef", "-1.0"]),
    (["--gamma", "nan"], ["--gamma", "nan"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_HWM_DREAMER = [
    (["--size", "huge"], ["--size", "huge", "thesis"]),
    (["--encoder", "cnn", "--frame-side", 22], ["--frame-side", "22", "64", "--encoder cnn"]),
    (["--kl-warmup", 0], ["--entropy-scale", "0.3", "--kl-warmup"]),
    (["--num-envs", 7], ["--num-envs", "7", "divide 500"]),
    (["--stoch-w", 0], ["--stoch-w", "0"]),
    (["--budget", 1.5], ["--budget", "1.5", "between 0 and 1"]),
    (["--temperature", 0], ["--temperature", "0.0"]),
    (["--fixed-interval", "-1"], ["--fixed-interval", "-1"]),
    (["--fixed-interval", 10], ["--fixed-interval", "10", "--chunk-length 10"]),
    (["--budget-updates", 0], ["--budget-updates", "0"]),
    (["--kl-z-scale", "nan"], ["--kl-z-scale", "nan"]),
    (["--total-timesteps", 10**15], ["--total-timesteps", "1000000000000000", "GB"]),
    (["--resume"], ["--resume", "--run-dir"]),
]
BAD_HRL = [*BAD_HWM_DREAMER, (["--num-skills", 1], ["--num-skills", "1", "at least 2"])]
BAD = {
    dqn: BAD_DQN,
    gopher: BAD_GOPHER,
    distill: BAD_DISTILL,
    ddpg: BAD_DDPG,
    gail: BAD_GAIL,
    rooms: BAD_ROOMS,
    hwm: BAD_HWM,
}
BAD |= {dreamer: BAD_DREAMER, hwm_dreamer: BAD_HWM_DREAMER, hwm_hrl_dreamer: BAD_HRL}


@pytest.mark.parametrize(
    "module, flags, words",
    [(module, *case) for module, cases in BAD.items() for case in cases],
    ids=lambda value: " ".join(map(str, value)) if isinstance(value, list) and str(value[0])[:2] == "--" else "",
)
def test_a_wrong_value_is_one_line_and_creates_nothing(module, flags, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(module, capsys, flags, words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "module, flags",
    [
        (dqn, ["--buffer-size", 2_000, "--learning-starts", 1_000]),
        (gopher, ["--obs-type", "ram", "--buffer-size", 10**6, "--learning-starts", 1_600]),  # larger than the run
        (gopher, ["--buffer-size", 400, "--learning-starts", 2_400, "--checkpoint-interval", 640]),
    ],
)
def test_the_disk_is_asked_for_as_much_as_the_replay_takes(module, flags, tmp_path, monkeypatch):
    asked, check = [], module.check_disk
    monkeypatch.setattr(module, "check_disk", lambda *its: asked.append(its[3]) or check(*its))
    script = ROOT / "cleanrl_thesis" / f"{module.__name__.split('.')[-1]}.py"
    run(*flags, "--total-timesteps", 2_560, "--eval-episodes", 1, "--run-dir", "run", cwd=tmp_path, script=script)
    assert asked == [(tmp_path / "run" / "replay.dat").stat().st_size]
