"""The one-file rule: a name that stands in several method files means the same code in each."""

import ast
from collections import defaultdict
from itertools import combinations
from pathlib import Path

import pytest

METHODS = sorted(
    path for path in (Path(__file__).parent.parent / "cleanrl_thesis").glob("*.py") if path.name != "__init__.py"
)
TOOLS = [path for path in METHODS if path.stem in ("record_human", "sensitivity_test")]  # the same rule holds for them
# (name, file): one line that says why it differs there; files with the same line have to be equal
PPO, DQN, DISTILL = "ppo_continuous_kle.py", "dqn_apple.py", "distill_hybrid.py"
GOPHER = "dqn_gopher.py"
DDPG, GAIL = "ddpg_torcs_like.py", "gail_hybrid.py"
ROOMS, HWM = "ppo_fourrooms.py", "hwm_segment.py"
DREAMER, HWM_DREAMER, HRL = "dreamer_v2.py", "hwm_dreamer.py", "hwm_hrl_dreamer.py"
RECORD, STUDY = "record_human.py", "sensitivity_test.py"
DREAMERS = {  # of all three
    "Collector": "plays with the world model, into the replay",
    "Player": "holds what the world model believes",
    "EVALUATION_STREAM": "no demonstrations",
    "play": "keeps what the world model believes",
}
DRIVING = {  # as PPO's twins are of chapter 4, these are of the driving task's two files
    "FPS": "control steps a second",
    "make_env": "bounded Box actions, and the options of the driving task",
    "make_games": "the driving task with its options",
    "play": "games that are made by the caller, continuous actions",
    "record_video": "continuous actions",
}
ATARI = {
    "Learner": "of DQN",
    "Minibatch": "stacks of frames, one step",
    "ReplayBuffer": "each frame once",
    "check_video": "games of ale-py",
    "record_video": "games of ale-py",
    "save_demonstrations": "games of ale-py, nearly greedy",
}
HWM_AGENTS = {
    "SIZES": "sizes of the HWM",
    "world_model_loss": "J_HWM",
    "Belief": "counts the steps of a segment",
    "HWM": "filters and dreams, by the actions before the frames; heads for reward and discount; categorical v and y",
    "Inference": "v and y may be categorical",
    "mlp": "ELU, torch's own initialisation",
    "Posterior": "cannot tell the ends of a chunk, which are shorter than those of the world model alone",
    "schedule": "of updates that go on as long as the agent plays",
}
DIFFERS: dict[tuple[str, str], str] = {
    ("CompiledUpdate", DQN): "has a target network, and a minibatch of transitions",
    ("Episode", DQN): "repeats an action for several frames, and needs no discounted return",
    ("FlatAdam", DQN): "one learning rate; the vector of the target network beside the agent's",
    ("PlainUpdate", DQN): "has a target network, and a minibatch of transitions",
    ("make_env", PPO): "Box actions instead of Discrete ones, and MuJoCo's islands",
    ("make_env", DISTILL): "image observations too",
    ("make_update", DQN): "has a target network",
    ("numpy_policy", PPO): "the mean of a Gaussian instead of an action",
    ("play", PPO): "one environment and normalised observations; the discrete methods play many games side by side",
    ("save_demonstrations", PPO): "plays one environment after the other",
    ("save_demonstrations", DISTILL): "the student's policy, sampled or greedy",
    **{(name, GOPHER): reason for name, reason in ATARI.items()},
    **{(name, file): reason for name, reason in DRIVING.items() for file in (DDPG, GAIL)},
    ("FlatAdam", DDPG): "actor and critic with a rate each, and their target networks",
    ("Means", DDPG): "metrics of DDPG",
    ("Minibatch", DDPG): "continuous actions, one step",
    ("ReplayBuffer", DDPG): "continuous actions, rows of several environments at once",
    ("Update", DDPG): "the losses of DDPG",
    ("make_policy", GAIL): "sampled or greedy",
    ("save_demonstrations", DDPG): "the actor without noise",
    ("Batch", GAIL): "what TRPO and the discriminator need",
    ("Rollout", GAIL): "real next observations instead of rewards",
    ("env_options", GAIL): "the reward is not seen",
    ("gae", GAIL): "values of the real next observations",
    ("make_batch", GAIL): "rewards by the discriminator",
    ("mlp", GAIL): "Baselines' initialisation",
    ("read_demonstrations", GAIL): "two experts, and the track",
    ("read_episode", GAIL): "continuous actions, two experts",
    ("EVALUATION_STREAM", GAIL): "its demonstrations are other episodes than the expert's",
    ("save_demonstrations", GAIL): "the student's policy, sampled or greedy, and the track",
    ("Batch", ROOMS): "images and discrete actions",
    ("Collector", ROOMS): "games by tables, whose state is a few arrays",
    ("Rollout", ROOMS): "images, and what the policy said of them",
    ("Update", ROOMS): "autograd and torch's Adam: the convolutions take the time",
    ("gae", ROOMS): "all games at once",
    ("make_batch", ROOMS): "the values are there already",
    ("make_env", ROOMS): "the side of the frames",
    ("play", ROOMS): "keeps states instead of frames",
    ("ppo_loss", ROOMS): "discrete actions",
    ("record_video", ROOMS): "frames of the agent's own size",
    ("save_demonstrations", ROOMS): "draws the frames of the states",
    ("write_demonstrations", ROOMS): "compressed",
    ("Episode", HWM): "a recorded one",
    ("LOG_INTERVAL", HWM): "updates, not environment steps",
    ("fingerprint", HWM): "frames and actions",
    ("mlp", HWM): "ELU, torch's own initialisation",
    ("read_demonstrations", HWM): "any environment with rooms",
    ("read_episode", HWM): "images, states and rooms",
    **{(name, file): reason for name, reason in DREAMERS.items() for file in (DREAMER, HWM_DREAMER, HRL)},
    **{(name, file): reason for name, reason in HWM_AGENTS.items() for file in (HWM_DREAMER, HRL)},
    **{(name, HRL): "two levels" for name in ("Behaviour", "Dream", "imagine", "behaviour_loss")},
    **{("cli", file): "no run, which could not go on" for file in (RECORD, STUDY)},
    ("Player", RECORD): "a person in a browser",
    ("make_app", STUDY): "of the study",
    ("read_arrays", STUDY): "what is needed to play an episode again",
    ("Collector", HRL): "keeps the skills that are played",
    ("Player", HRL): "holds what the world model believes, and the skill",
}
OWN = {  # each method's own by design
    *("Args", "Agent", "complete_args", "main", "evaluate", "finish_run", "plot_learning_curve", "print_table"),
    *("CHECKPOINT_FORMAT", "FINISH", "FREE_ON_RESUME"),
}
ALIKE = {  # but word for word equal in these
    "main": [(HWM_DREAMER, HRL)],
    "evaluate": [(DREAMER, HWM_DREAMER, HRL)],
    "finish_run": [(DREAMER, HWM_DREAMER, HRL)],
    "print_table": [(PPO, DQN), (DREAMER, HWM_DREAMER, HRL, ROOMS)],
    "FINISH": [(DDPG, DQN), (PPO, DISTILL, GAIL), (DREAMER, HWM_DREAMER, HRL)],
    "FREE_ON_RESUME": [(DDPG, DQN), (PPO, ROOMS, DREAMER, HWM_DREAMER, HRL)],
}


def definitions(source: str) -> dict[str, str]:
    """Each top-level class, function and constant of a file, and each loop or condition there, as the dump of its syntax tree."""
    found = defaultdict(str)
    for node in ast.parse(source).body:
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            found[node.name] += ast.dump(node)
        elif isinstance(node, (ast.Assign, ast.AugAssign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in ast.walk(ast.Tuple(targets, ast.Store())):
                if isinstance(target, ast.Name) and isinstance(target.ctx, ast.Store):
                    found[target.id] += ast.dump(node)
        elif isinstance(node, (ast.For, ast.If, ast.With, ast.Try)):
            found[ast.unparse(node).splitlines()[0]] += ast.dump(node)  # such as the registration of environments
    return found


def differing(files: dict[str, str]) -> list[tuple[str, str, str]]:
    """(name, file, other file) of every definition that is not word for word its twin."""
    by_name = defaultdict(dict)
    for file, source in files.items():
        for name, dump in definitions(source).items():
            by_name[name][file] = dump
    return [
        (name, one, other)
        for name, copies in by_name.items()
        if name not in OWN
        for one, other in combinations(copies, 2)
        if copies[one] != copies[other] and DIFFERS.get((name, one)) == DIFFERS.get((name, other))
    ]


def imported_modules(source: str) -> set[str]:
    """The first part of every imported module's name."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names.add("." if node.level else node.module.split(".")[0])
    return names


def test_twins_are_equal():
    assert differing({path.name: path.read_text() for path in METHODS}) == []


@pytest.mark.parametrize("name", ALIKE)
def test_what_is_own_is_alike_where_it_can_be(name):
    found = {path.name: definitions(path.read_text()) for path in METHODS}
    for files in ALIKE[name]:
        assert len({found[file][name] for file in files}) == 1, (name, files)


def methods_of(source: str, name: str) -> dict[str, str]:
    """Each method of a class, as the dump of its syntax tree."""
    body = next(node for node in ast.parse(source).body if isinstance(node, ast.ClassDef) and node.name == name).body
    return {node.name: ast.dump(node) for node in body if isinstance(node, ast.FunctionDef)}


@pytest.mark.parametrize(
    "name, methods", [("Collector", ("__init__", "reset", "step")), ("Player", ("observe", "act_randomly"))]
)
def test_agents_with_skills_play_as_those_without(name, methods):
    """Only what they keep, and how they act, is their own."""
    files = [path for path in METHODS if path.name in (DREAMER, HWM_DREAMER, HRL)]
    found = [methods_of(path.read_text(), name) for path in files]
    for method in methods:
        assert len({each[method] for each in found}) == 1 and len(found) == 3, method


def test_no_method_imports_another():
    for path in METHODS:
        forbidden = {"cleanrl_thesis", ".", *(other.stem for other in METHODS)}
        assert not imported_modules(path.read_text()) & forbidden, path.name


def test_no_exemption_is_stale():
    """Each is of a name that stands there and in another file too."""
    found = {path.name: definitions(path.read_text()) for path in METHODS}
    for name, file in DIFFERS:
        assert name in found[file], (name, file)
        assert any(name in found[other] for other in found if other != file), (name, file)
    for name in OWN:
        assert sum(name in names for names in found.values()) > 1, name


def test_a_changed_twin_would_be_found():
    one = "def f(x):\n    return x\n\nC, D = 1, 2\n"
    assert differing({"a.py": one, "b.py": one + "# a comment\n"}) == []
    assert differing({"a.py": one, "b.py": one.replace("return x", "return -x")}) == [("f", "a.py", "b.py")]
    assert differing({"a.py": one, "b.py": one.replace("1, 2", "1, 3")}) == [
        ("C", "a.py", "b.py"),
        ("D", "a.py", "b.py"),
    ]
    loop = "E = {1}\nE |= {2}\nfor x in E:\n    print(x)\n"
    assert differing({"a.py": loop, "b.py": loop.replace("{2}", "{3}")}) == [("E", "a.py", "b.py")]
    assert differing({"a.py": loop, "b.py": loop.replace("(x)", "(-x)")}) == [("for x in E:", "a.py", "b.py")]
    assert imported_modules("from . import x\nimport cleanrl_thesis.y") == {".", "cleanrl_thesis"}
