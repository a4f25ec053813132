"""Processes that are forked instead of started are as those that are started, for whoever looks after them."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import msgspec

from runner.contract import Stage
from runner.process.children import Handle, end_process
from runner.process.forks import Forked, clean_environment
from runner.process.stage_process import Assignment, prepare
from tests.runner.common.survivors import lives
from tests.runner.common.waiting import wait_until

SUPERVISOR = """
import contextlib, json, os, signal, subprocess, sys, tempfile, threading, time
from pathlib import Path
from runner.process.children import Descendants
from runner.process.fork_server import ForkServer
from runner.process.forks import Forked, Threads, fork
folder, said = Path(sys.argv[1]), []
def start(task, name="one", mark=""):
    log = folder / f"{name}.txt"
    return forks.start("tests.runner.process.does_its_task", name, task=task.encode(), log=log, mark=mark)
def server():
    (pid,) = [pid for pid in children() if b"fork_server" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return pid
def children():
    return [int(pid) for pid in Path("/proc/self/task", str(os.getpid()), "children").read_text().split()]
def show(*values):
    print(json.dumps(values), flush=True)
"""
FORKS = "forks = ForkServer(said.append)\n"


def supervisor(folder: Path, script: str, *, forks: str = FORKS) -> subprocess.Popen[str]:
    """A process that starts others; what it shows are lines of JSON."""
    command = [sys.executable, "-c", SUPERVISOR + forks + script, str(folder)]
    return subprocess.Popen(command, env=clean_environment(), stdout=subprocess.PIPE, text=True)


def shown(folder: Path, script: str, *, forks: str = FORKS) -> list[list[object]]:
    """All that such a process shows, once it has ended well."""
    process = supervisor(folder, script, forks=forks)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    return [json.loads(line) for line in output.splitlines()]


def test_how_a_process_ends_is_known_to_who_started_it(tmp_path: Path):
    tasks = ("code = 0", "code = 7", "import sys; sys.exit(3)", "import sys; sys.exit('no room')", "1 / 0")
    tasks += ("import os; os.kill(os.getpid(), 9)", "import os; os.abort()")
    script = f"show(*[start(task, str(n)).wait() for n, task in enumerate({tasks})]); forks.close(); show(children())"
    assert shown(tmp_path, script) == [[0, 7, 3, 1, 1, -signal.SIGKILL, -signal.SIGABRT], [[]]]
    assert (tmp_path / "3.txt").read_text() == "no room\n"
    assert (tmp_path / "4.txt").read_text().splitlines()[-1] == "ZeroDivisionError: division by zero"


def test_a_process_whose_end_another_thread_sees_is_signalled_in_vain():
    class Seen(Forked):
        def poll(self) -> int | None:
            found = super().poll()
            wait_until(lambda: super(Seen, self).poll() is not None)
            return found

    process = Seen(os.posix_spawn(sys.executable, [sys.executable, "-c", "import time; time.sleep(0.1)"], {}))
    process.send_signal(signal.SIGCONT)
    assert process.wait() == 0
    process.send_signal(signal.SIGCONT)


def test_a_process_is_waited_for_and_signalled_alone_or_with_its_group(tmp_path: Path):
    script = """
one = start("import subprocess, time; print(subprocess.Popen(['sleep', '600']).pid, flush=True); time.sleep(600)")
with contextlib.suppress(subprocess.TimeoutExpired):
    one.wait(0.05)
    show("it has ended")
while not (folder / "one.txt").read_text():
    time.sleep(0.01)
show(one.poll(), os.getpgid(one.pid) == one.pid)
one.signal_group(signal.SIGTERM)
show(one.wait(), one.poll(), one.returncode)
one.send_signal(signal.SIGTERM)
one.signal_group(signal.SIGTERM)
"""
    ended = -signal.SIGTERM
    assert shown(tmp_path, script) == [[None, True], [ended, ended, ended]]
    wait_until(lambda: not lives(int((tmp_path / "one.txt").read_text())))


def test_a_forked_process_is_as_one_that_was_started(tmp_path: Path):
    task = """
import json, os, sys
from pathlib import Path
open_files = sorted(int(name) for name in os.listdir('/proc/self/fd'))[:-1]
title = Path('/proc/self/cmdline').read_text().replace('\\\\0', ' ').strip()
print('printed'); os.system('echo by a child'); print(sys.stdin.read(), 'nothing more', file=sys.stderr)
parents = [os.getppid(), os.environ['RUNNER_PARENT']]
print(json.dumps([*parents, os.getpgid(0) == os.getpid(), open_files, title, sys.argv]))
"""
    script = f"one = start('''{task}''', 'arm.0'); show(one.wait(), os.getpid()); show(said)"
    (code, pid), said = shown(tmp_path, script)
    printed = (tmp_path / "arm.0.txt").read_text().splitlines()
    assert (code, said) == (0, [[]])
    assert printed[:3] == ["printed", "by a child", " nothing more"]
    module = "tests.runner.process.does_its_task"
    assert json.loads(printed[3]) == [pid, str(pid), True, [0, 1, 2], f"{module} arm.0", [module]]


def test_what_is_to_be_done_at_the_end_is_done_and_nothing_of_others(tmp_path: Path):
    task = "import tempfile, threading, time, atexit; atexit.register(print, 'at the end'); "
    task += "threading.Thread(target=lambda: (time.sleep(0.1), print('a thread'))).start(); print(sorted(globals()))"
    script = f"""
with tempfile.TemporaryDirectory() as own:
    one = Forked(fork(lambda: 5, folder / "log.txt"))
    show(one.wait(), Path(own).exists(), start({task!r}).wait())
"""
    assert shown(tmp_path, script) == [[5, True, 0]]
    assert sorted((tmp_path / "one.txt").read_text().splitlines()[1:]) == ["a thread", "at the end"]


def test_what_is_prepared_in_the_fork_server_is_there_in_what_it_forks(tmp_path: Path):
    script = """
said = [start("print(*PREPARED)", str(number)).wait() for number in range(3)]
show(*said, server(), [(folder / f"{number}.txt").read_text() for number in range(3)])
"""
    ((*codes, server, printed),) = shown(tmp_path, script)
    assert (codes, printed) == ([0, 0, 0], [f"{server}\n", f"{server} {server}\n", f"{server} {server} {server}\n"])


class Prepared(Stage):
    times: ClassVar[list[None]] = []

    @classmethod
    def prepare(cls, config: None) -> None:
        cls.times.append(None)

    def on_start(self) -> None: ...


def test_a_stage_is_prepared_once_for_all_its_replicas():
    entry = {"stage": f"{__name__}:Prepared"}
    assignment = Assignment("run", "endpoint", "folder", "one", entry, seed=0, routes=(), processes=())
    for replica in range(3):
        prepare(msgspec.json.encode(msgspec.structs.replace(assignment, replica=replica)))
    assert len(Prepared.times) == 1


def test_fifty_processes_start_at_once(tmp_path: Path):
    script = """
fifty = [start(f"import time; time.sleep(0.2); code = {number}", str(number)) for number in range(50)]
show(len({one.pid for one in fifty}), [one.wait() for one in fifty] == list(range(50)), said)
"""
    assert shown(tmp_path, script) == [[50, True, []]]


def test_with_the_supervisor_dies_all_that_it_has_started(tmp_path: Path):
    task = "from runner.process.children import die_with_parent; die_with_parent(); import time; time.sleep(600)"
    script = f"""
started = [start({task!r}, str(number)).pid for number in range(3)]
show(*started, server())
os.kill(os.getpid(), signal.SIGKILL)
"""
    process = supervisor(tmp_path, script)
    output, _ = process.communicate(timeout=60)
    pids = json.loads(output)
    assert len(pids) == 4
    wait_until(lambda: not any(map(lives, pids)))


def test_without_its_fork_server_a_supervisor_goes_on(tmp_path: Path):
    script = """
first = start("import time; time.sleep(600)", "first")
os.kill(server(), signal.SIGKILL)
second = start("print('started'); code = 4", "second")
show(second.wait(), first.poll(), said)
first.kill()
show(start("code = 6").wait(), len(said))
forks.close()
"""
    (code, living, said), later = shown(tmp_path, script)
    assert (code, living, later) == (4, None, [6, 1])
    assert said == ["the fork server killed by SIGKILL; from now on every process imports what it needs by itself"]
    assert (tmp_path / "second.txt").read_text() == "started\n"


def test_a_fork_server_that_stands_still_is_not_waited_for_without_end(tmp_path: Path):
    script = """
import runner.process.fork_server
runner.process.fork_server.PREPARE_SECONDS = 1.0
os.kill(server(), signal.SIGSTOP)
show(start("code = 4", "second").wait(), said)
forks.close()
"""
    ((code, said),) = shown(tmp_path, script)
    reason = "the fork server has not started second after 1 s"
    assert (code, said) == (4, [f"{reason}; from now on every process imports what it needs by itself"])


class Unkillable(Handle):
    """A process that waits for a disk that does not answer: signals change nothing."""

    pid, returncode = 2**22, None

    def poll(self) -> None:
        """It is always there."""


def test_a_process_that_cannot_be_killed_is_left():
    left = Unkillable()
    end_process(left, 0.1)
    assert left.poll() is None


def test_a_process_with_threads_is_not_forked(tmp_path: Path):
    threaded = "stop = threading.Event(); thread = threading.Thread(target=stop.wait); thread.start()\n"
    script = """
with contextlib.suppress(Threads):
    fork(lambda: 0)
    show("forked")
show(start("code = 8").wait(), *said)
stop.set()
"""
    ((code, said),) = shown(tmp_path, script, forks=threaded + FORKS)
    assert code == 8
    assert str(said).startswith("what stages import must start no threads, or no process can be forked: python")


def test_what_a_forked_process_leaves_behind_is_found(tmp_path: Path):
    task = "import os, subprocess, time\n"
    task += "subprocess.Popen(['sleep', '600'], start_new_session=True); pid = os.fork()\n"
    task += "if pid == 0: os.setsid(); time.sleep(600)\nprint('ready', flush=True)"
    script = f"""
descendants = Descendants()
one = start({task!r}, "one", descendants.mark("one/0/0"))
other = start({task!r}, "other", descendants.mark("other/0/0"))
show(one.wait(), other.wait())
show(sorted(descendants.end("one/0/0")), sorted(descendants.close()))
"""
    found = [
        ["sleep 600", "tests.runner.process.does_its_task one"],
        ["sleep 600", "tests.runner.process.does_its_task other"],
    ]
    assert shown(tmp_path, script) == [[0, 0], found]
