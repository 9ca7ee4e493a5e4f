"""benchmark/sweep.py on a real Slurm of two nodes, started here on localhost."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import NO_SKIPS, ROOT, SMALL, assert_same_run, command

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "scontrol", "squeue")
MISSING = [name for name in PROGRAMS if shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") is None]
pytestmark = [
    pytest.mark.skipif(
        bool(MISSING) and not NO_SKIPS,
        reason=f"{', '.join(MISSING)} not installed: apt-get install slurmctld slurmd slurm-client munge",
    ),
    pytest.mark.skipif(os.geteuid() != 0 and not NO_SKIPS, reason="slurmd needs root to start jobs"),
    pytest.mark.timeout(600),
    pytest.mark.slow,
]
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool_%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd_%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd_%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
ReturnToService=2
SlurmdTimeout=5
KillWait=2
SchedulerParameters=batch_sched_delay=1,sched_interval=2
NodeName=one NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=1 RealMemory=4000
NodeName=two NodeHostname={host} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=1 RealMemory=4000
PartitionName=all Nodes=one,two Default=YES State=UP
"""


def free_ports(number: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


def wait_until(condition, seconds: float, what: str):
    """What `condition` returns, once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.2)
    raise AssertionError(f"{what}: not within {seconds} s")


class Cluster:
    """A controller and two nodes; `stop` ends them and all that they have started."""

    def __init__(self, folder: Path):
        self.folder, self.daemons = folder, {}
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
        self.environment["PATH"] += ":/usr/sbin"
        (folder / "state").mkdir()
        text = CONFIGURATION.format(folder=folder, ports=free_ports(3), host=socket.gethostname().split(".")[0])
        (folder / "slurm.conf").write_text(text)

    def begin(self) -> None:
        """Start all daemons and wait for them. Raises AssertionError where they do not come up."""
        folder = self.folder
        key = folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o400)
        files = {"key-file": key, "socket": folder / "munge.socket", "pid-file": folder / "munge.pid"}
        files |= {"log-file": folder / "munge.log", "seed-file": folder / "munge.seed"}
        self.start("munged", "--foreground", "--force", *(f"--{name}={path}" for name, path in files.items()))
        wait_until((folder / "munge.socket").exists, 10, "munged")
        self.start("slurmctld", "-D")
        for node in ("one", "two"):
            self.start_node(node)
        self.wait_for_idle_nodes()

    def start(self, *words: str, name: str = "") -> None:
        with open(self.folder / "daemons.log", "ab") as log:
            streams = {"stdout": log, "stderr": log, "start_new_session": True}
            self.daemons[name or words[0]] = subprocess.Popen(words, env=self.environment, **streams)

    def start_node(self, node: str) -> None:
        self.start("slurmd", "-D", "-N", node, name=node)

    def wait_for_idle_nodes(self) -> None:
        wait_until(lambda: self.ask("sinfo", "--noheader", "--format=%T").split() == ["idle"], 60, "two idle nodes")

    def ask(self, *words: str) -> str:
        return subprocess.run(words, env=self.environment, capture_output=True, text=True).stdout

    def kill_node(self, node: str) -> None:
        """As when its power goes: daemon, step managers and then the jobs, which nobody is left to report on."""
        self.daemons.pop(node).kill()
        jobs, steps = [], set()
        for path in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                environment = (path / "environ").read_bytes().split(b"\0")
                if f"SLURMD_NODENAME={node}".encode() in environment and self.is_own(environment):
                    jobs.append(int(path.name))
                    parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
                    if Path(f"/proc/{parent}/comm").read_text().startswith("slurmstepd"):
                        steps.add(parent)
        for process in (*steps, *jobs):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)

    def is_own(self, environment: list[bytes]) -> bool:
        return f"SLURM_CONF={self.folder / 'slurm.conf'}".encode() in environment

    def stop(self) -> None:
        self.ask("scancel", "--full", "--user=root")
        for node in ("one", "two"):
            if node in self.daemons:
                self.kill_node(node)
        for daemon in self.daemons.values():
            daemon.kill()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("slurm"))
    try:
        try:
            cluster.begin()
        except AssertionError as error:
            if NO_SKIPS:
                raise
            pytest.skip(f"Slurm does not start here: {error}")
        yield cluster
    finally:
        cluster.stop()


def test_a_sweep_survives_the_death_of_a_node_and_a_warning(cluster, tmp_path):
    """Four runs on two nodes. One dies, a task of the other gets the signal by which Slurm warns: same bytes at the end."""
    flags = [*SMALL, "--total-timesteps", "40960", "--checkpoint-interval", "1024"]
    whole = tmp_path / "whole"
    for seed in (1, 2):
        subprocess.run(command(*flags, "--seed", seed, "--run-dir", whole / str(seed)), check=True, capture_output=True)
    script = ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py"
    (tmp_path / "runs" / "logs").mkdir(parents=True)
    words = ["--command", f"{sys.executable} {script} {' '.join(flags[2:])}", "--env-ids", "Pendulum-v1"]
    words += ["--num-seeds", "2", "--grid", "target-kl=1,2", "--workers", "4", "--runs", str(tmp_path / "runs")]
    words += ["--slurm-template-path", str(ROOT / "benchmark" / "slurm_template.sh")]
    sweep = [sys.executable, str(ROOT / "benchmark" / "sweep.py"), *words]
    done = subprocess.run(sweep, env=cluster.environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("4 runs in job "), done.stdout + done.stderr
    again = subprocess.run(sweep, env=cluster.environment, cwd=tmp_path, capture_output=True, text=True)
    assert again.returncode == 2 and "still queued" in again.stderr

    def begun() -> list[Path]:
        """Runs with a checkpoint, not at their end."""
        folders = [path.parent for path in (tmp_path / "runs").glob("*/checkpoint.pt")]
        return [folder for folder in folders if not (folder / "result.json").exists()]

    wait_until(lambda: len(begun()) >= 2, 120, "two runs with a checkpoint")
    jobs = cluster.ask("squeue", "--noheader", "--states=R", "--array", "--format=%i %N").split("\n")
    on_two = next(line.split()[0] for line in jobs if line.endswith(" two"))
    cluster.kill_node("one")
    cluster.ask("scancel", "--batch", "--signal=USR1", on_two)  # Slurm itself looks at time limits twice a minute only
    wait_until(lambda: "down" in cluster.ask("sinfo", "--noheader", "--format=%T"), 60, "the dead node is found")
    wait_until(lambda: not cluster.ask("squeue", "--noheader"), 400, "an empty queue")
    cluster.start_node("one")  # only now: the controller still sends it a kill, which would meet the next attempt
    cluster.wait_for_idle_nodes()

    for folder in sorted((tmp_path / "runs").glob("*__seed*")):
        assert_same_run(whole / folder.name[-1], folder)
    assert len(list((tmp_path / "runs").glob("*__seed*/result.json"))) == 4
    logs = "\n".join(path.read_text() for path in (tmp_path / "runs" / "logs").glob("slurm_*.log"))
    assert "stopped by signal 10" in logs, logs  # more than once where Slurm, busy with the dead node, sends it again
    log = (cluster.folder / "slurmctld.log").read_text()
    assert log.count("Requeu") + log.count("requeue") >= 2, log


def test_a_crash_is_queued_again_and_a_mistake_is_not(cluster, tmp_path):
    """Runs of milliseconds: one that crashes in its ninth step, and one of an environment that does not exist."""
    toy = ROOT / "tests" / "data" / "toy_run.py"
    words = ["--command", f"{sys.executable} -I {toy}", "--env-ids", "A-v0", "no/Such-v0", "--num-seeds", "1"]
    words += ["--variants", "crash-at=9", "--workers", "2", "--runs", "runs"]
    words += ["--slurm-template-path", str(ROOT / "benchmark" / "slurm_template.sh")]
    sweep = [sys.executable, str(ROOT / "benchmark" / "sweep.py"), *words]
    subprocess.run(sweep, env=cluster.environment, cwd=tmp_path, capture_output=True, check=True)
    wait_until(lambda: not cluster.ask("squeue", "--noheader"), 120, "an empty queue")
    steps = (tmp_path / "runs" / "A-v0__crash-at=9__seed1" / "steps.txt").read_text().splitlines()
    assert [line.split()[0] for line in steps] == [str(i) for i in range(1, 21)]
    logs = sorted((tmp_path / "runs" / "logs").glob("slurm_*.log"))
    assert [log.read_text().count("invalid choice: 'no/Such-v0'") for log in logs] == [0, 1]
    crashes = [path.read_text() for path in (tmp_path / "runs" / "logs").glob("crashes_*")]
    assert crashes == ["exit code 134\n"]
