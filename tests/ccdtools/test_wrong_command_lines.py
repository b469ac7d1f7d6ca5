"""Every wrong command line is answered by one line that names what is wrong, exit code 2, and no folder."""

import os
import subprocess
import sys

import numpy as np
import pytest

from ccdtools.cli import main, plain_where_needed

RUN = ["run", "suspension"]
TIMES = "time,dz_dt\n" + "".join(f"{0.05 * i:.2f},0.1\n" for i in range(600))

FILES = {
    "a.py": "study = 3",
    "empty.py": "",
    "note.txt": "study",
    "empty.csv": "",
    "header.csv": "dz_dt\n",
    "nan.csv": "dz_dt\n0.1\nnan\n" + "0.0\n" * 600,
    "words.csv": "dz_dt\n" + "zero\n" * 600,
    "two.csv": "a,b\n" + "0.1,0.2\n" * 600,
    "uneven.csv": "time,dz_dt\n0,0\n0.05,0\n0.2,0\n" + "".join(f"{0.3 + i},0\n" for i in range(600)),
    "slow.csv": "time,dz_dt\n" + "".join(f"{0.1 * i:.1f},0\n" for i in range(600)),
    "times.csv": TIMES,
    "rest.csv": "dz_dt\n" + "0\n" * 600,
    "gap.csv": "dz_dt\n" + "0.1\n" * 300 + "\n" + "0.1\n" * 300,
    "short.csv": "dz_dt\n0.1\n0.2\n0.1\n",
    "huge.csv": "dz_dt\n" + "1e300\n-1e300\n" * 300,
    "bare.csv": "0.1\n" * 600,
    "ragged.csv": "a,b\n1,2\n3\n",
    "road.csv": "distance,elevation\n" + "".join(f"{i},0\n" for i in range(2000)),
    "back.csv": "distance,elevation\n0,0\n2,0\n1,0\n",
    "speed.csv": "time,speed\n" + "".join(f"{i},30\n" for i in range(100)),
    "reverse.csv": "time,speed\n0,30\n1,-30\n",
    "blink.csv": "time,speed\n0,30\n0.01,30\n",
    "no.toml": "quick = true\n",
    "key.toml": 'study = "suspension"\nsede = [0, 1]\n',
    "twice.toml": 'study = "suspension"\nseed = [0, 0]\n',
    "none.toml": 'study = "suspension"\nseed = []\n',
    "value.toml": 'study = "suspension"\npreset = ["default", "fast"]\n',
    "kind.toml": 'study = "suspension"\nseed = "zero"\n',
    "other.toml": 'study = ["suspension", 3]\n',
    "study.toml": 'study = "unheard-of"\n',
    "broken.toml": "study = \n",
    "afar.csv": "time,speed\n0,100\n100000,100\n",
}

WRONG = [
    # What is run
    (["run"], "study: got nothing, expected the name of a study"),
    (["run", "unheard-of"], "study: got 'unheard-of', expected one of backlash_servo, dc_servo, full_car, "),
    (["run", ""], "study: got ''"),
    (["run", "Suspension"], "or a Python file. Did you mean suspension?"),
    (["run", "a"], "A file needs its ending: a.py."),
    (["run", "note.txt"], "study: got 'note.txt'"),
    (["run", "absent.py"], "absent.py, which is not a file"),
    (["run", "place.py"], "place.py, which is not a file"),
    (["run", "a.py"], "a.py, which declares no `study`"),
    (["run", "empty.py"], "empty.py, which declares no `study`"),
    (["run", "suspension", "illustrative"], "arguments: got illustrative besides"),
    (["run", "../suspension"], "study: got '../suspension'"),
    (
        ["run", "full_car_drivers", "--generations", "3"],
        "--generations: got it for 'full_car_drivers', whose designs "
        "stand side by side, expected --seed, --quick and --p0 alone",
    ),
    # What is swept
    (["sweep"], "file: got nothing"),
    (["sweep", "absent.toml"], "absent.toml: No such file or directory, expected a TOML file with options"),
    (["sweep", "broken.toml"], "file: got broken.toml: Invalid value (at line 1"),
    (["sweep", "no.toml"], 'file: got no study, expected a line such as study = "suspension"'),
    (["sweep", "key.toml"], "file: got the key 'sede', expected one of study, generations, seed,"),
    (["sweep", "twice.toml"], "file: got seed = 0, 0, expected values that do not repeat"),
    (["sweep", "none.toml"], "file: got seed = [], expected at least one value"),
    (["sweep", "value.toml"], "--preset: got 'fast', expected one of default, paper"),
    (["sweep", "kind.toml"], "--seed: got 'zero'"),
    (["sweep", "other.toml"], "file: got study = 3, expected text"),
    (["sweep", "study.toml"], "study: got 'unheard-of'"),
    # Commands and options that do not exist
    (
        ["rum", "suspension"],
        "command: got 'rum', expected run, resume, sweep, codesign, reproduce, export, new or studies. Did you mean "
        "run?",
    ),
    (["Run", "suspension"], "command: got 'Run'"),
    (["suspension"], "command: got 'suspension'"),
    (["--quick"], "--quick: got an unknown option"),
    ([*RUN, "--sead", "1"], "--sead: got an unknown option, expected one that exists. Did you mean --seed?"),
    ([*RUN, "--fast"], "--fast: got an unknown option"),
    ([*RUN, "-q"], "-q: got an unknown option"),
    ([*RUN, "--seed"], "--seed: got it without a value"),
    ([*RUN, "--x0"], "--x0: got it without a value"),
    ([*RUN, "--quick=yes"], "--quick: got it with a value"),
    ([*RUN, "--overwrite=1"], "--overwrite: got it with a value"),
    (["studies", "all"], "arguments: got all besides"),
    (["resume", "a", "b"], "arguments: got b besides"),
    (["resume", "--seed", "1", "a"], "--seed: got an unknown option"),
    # Whole numbers
    ([*RUN, "--seed", "one"], "--seed: got 'one', expected a whole number"),
    ([*RUN, "--seed", "1.5"], "--seed: got '1.5'"),
    ([*RUN, "--seed=-1"], "--seed: got -1, expected a whole number, at least 0"),
    ([*RUN, "--seed", "1e3"], "--seed: got '1e3'"),
    ([*RUN, "--seed", "1_0"], "--seed: got '1_0'"),
    ([*RUN, "--seed", ""], "--seed: got ''"),
    ([*RUN, "--seed", "nan"], "--seed: got 'nan'"),
    ([*RUN, "--generations", "0"], "--generations: got 0, expected a whole number, at least 1"),
    ([*RUN, "--generations=-2"], "--generations: got -2"),
    ([*RUN, "--generations", "two"], "--generations: got 'two'"),
    ([*RUN, "--generations", "2.0"], "--generations: got '2.0'"),
    ([*RUN, "--generations", "inf"], "--generations: got 'inf'"),
    # Choices
    ([*RUN, "--filter", "safe"], "--filter: got 'safe', expected one of none, admissible"),
    ([*RUN, "--limits", "lqr"], "--limits: got 'lqr', expected mpc, off, or two numbers"),
    ([*RUN, "--limits", "0.1"], "--limits: got '0.1', expected mpc, off, or two numbers"),
    ([*RUN, "--limits=-0.1,0.1"], "--limits: got -0.1"),
    ([*RUN, "--preset", "papr"], "--preset: got 'papr', expected one of default, paper"),
    ([*RUN, "--preset", ""], "--preset: got ''"),
    ([*RUN, "--preset", "PAPER"], "--preset: got 'PAPER'"),
    ([*RUN, "--expert", "pid"], "--expert: got 'pid', expected one of auto, lqr, mpc, explicit"),
    ([*RUN, "--expert", "LQR"], "--expert: got 'LQR'"),
    ([*RUN, "--sets", "off"], "--sets: got 'off', expected one of auto, lqr, none"),
    ([*RUN, "--sets-time-limit", "0"], "--sets-time-limit: got 0"),
    ([*RUN, "--drift", "2"], "--drift: got 2"),
    ([*RUN, "--drift", "often"], "--drift: got 'often', expected one number, such as 0.05"),
    ([*RUN, "--sets-time-limit", "soon"], "--sets-time-limit: got 'soon'"),
    ([*RUN, "--sets-time-limit", "3,4"], "--sets-time-limit: got '3,4', expected one number, in seconds"),
    ([*RUN, "--sets-time-limit", "1h"], "such as 3600 for an hour"),
    ([*RUN, "--design-gradient", "up"], "--design-gradient: got 'up', expected one of pathwise, network_input"),
    ([*RUN, "--design-gradient", "network-input"], "--design-gradient: got 'network-input'"),
    # Options without an effect
    ([*RUN, "--generations", "1", "--redesign-price", "2 %"], "--redesign-price: got it with --generations 1"),
    ([*RUN, "--generations", "1", "--redesign-cost", "2 return, serves 9"], "--redesign-cost: got it with --gen"),
    ([*RUN, "--redesign-cost", "500 EUR"], "--redesign-cost: got '500 EUR', expected a text like \"500 EUR, serves"),
    ([*RUN, "--redesign-cost", "500 EUR, serves 9"], "worth: got nothing, expected what one unit of return is worth"),
    ([*RUN, "--redesign-cost", "5 EUR, serves 9, lasts 3"], "--redesign-cost: got '5 EUR, serves 9, lasts 3'"),
    ([*RUN, "--sets", "none", "--sets-time-limit", "5"], "--sets-time-limit: got it with sets 'none', which computes"),
    ([*RUN, "--sets", "lqr", "--sets-time-limit", "5"], "--sets-time-limit: got it with sets 'lqr', which computes"),
    ([*RUN, "--preset", "paper", "--method", "pathwise+ppo"], "--method: got 'pathwise+ppo' with --preset paper"),
    ([*RUN, "--driver", "wild"], "--driver: got 'wild', expected one of mild, aggressive"),
    ([*RUN, "--driver", ""], "--driver: got ''"),
    # Starts
    (["run", "illustrative", "--x0=one,2"], "--x0: got 'one,2', expected finite numbers separated by commas"),
    (["run", "illustrative", "--x0=1;2"], "--x0: got '1;2'"),
    (["run", "illustrative", "--x0="], "--x0: got ''"),
    (["run", "illustrative", "--x0=1,"], "--x0: got '1,'"),
    (["run", "illustrative", "--x0=nan,0"], "--x0: got 'nan,0'"),
    (["run", "illustrative", "--x0=inf,0"], "--x0: got 'inf,0'"),
    (["run", "illustrative", "--x0=1e999,0"], "--x0: got '1e999,0'"),
    (["run", "illustrative", "--x0=1_0,0"], "--x0: got '1_0,0'"),
    (["run", "illustrative", "--x0=[1,2]"], "--x0: got '[1,2]'"),
    (["run", "illustrative", "--x0=1,2,3"], "--x0: got shape (3,), expected 2 numbers"),
    (["run", "illustrative", "--x0=1"], "--x0: got shape (1,), expected 2 numbers"),
    (["run", "illustrative", "--x0=5.1,0"], "--x0: got [5.1, 0.0], which is outside X"),
    (["run", "illustrative", "--x0=0,-50"], "--x0: got [0.0, -50.0], which is outside X"),
    (["run", "illustrative", "--p0=nan"], "--p0: got 'nan'"),
    (["run", "illustrative", "--p0=big"], "--p0: got 'big'"),
    (["run", "illustrative", "--p0=0.49"], "--p0: got p = 0.49, expected a value in [0.5, 3]"),
    (["run", "illustrative", "--p0=1,2"], "--p0: got shape (2,), expected 1 number"),
    ([*RUN, "--p0=1e4,5000"], "--p0: got c_s = 5000, expected a value in [500, 3000] N·s/m"),
    ([*RUN, "--p0=1e4"], "--p0: got shape (1,), expected 2 numbers"),
    # Recordings
    ([*RUN, "--disturbance", "no.csv"], "--disturbance: got 'no.csv', which is not a file"),
    ([*RUN, "--disturbance", ""], "--disturbance: got ''"),
    ([*RUN, "--disturbance", "place.py"], "--disturbance: got 'place.py', which is not a file"),
    ([*RUN, "--disturbance", "empty.csv"], "--disturbance: got empty.csv"),
    ([*RUN, "--disturbance", "header.csv"], "--disturbance: got header.csv"),
    ([*RUN, "--disturbance", "nan.csv"], "--disturbance: got nan.csv"),
    ([*RUN, "--disturbance", "words.csv"], "--disturbance: got words.csv"),
    ([*RUN, "--disturbance", "two.csv"], "--disturbance: got two.csv"),
    ([*RUN, "--disturbance", "two.csv", "--column", "c"], "no column 'c'"),
    ([*RUN, "--disturbance", "times.csv", "--column", "time"], "column 'time', which holds the times"),
    ([*RUN, "--disturbance", "gap.csv"], "a blank line 302, expected one row per sample"),
    ([*RUN, "--disturbance", "uneven.csv"], "--disturbance: got uneven.csv"),
    ([*RUN, "--disturbance", "slow.csv"], "--disturbance: got slow.csv"),
    ([*RUN, "--disturbance", "short.csv"], "--disturbance: got 3 samples, expected at least 500"),
    ([*RUN, "--disturbance", "huge.csv"], "Check its units."),
    ([*RUN, "--disturbance", "mm.csv"], "of the samples, expected a recording that the plant can bear"),
    ([*RUN, "--disturbance", "bare.csv"], "--disturbance: got bare.csv"),
    ([*RUN, "--disturbance", "ragged.csv"], "--disturbance: got ragged.csv"),
    ([*RUN, "--disturbance", "latin.csv"], "--disturbance: got latin.csv"),
    (["run", "illustrative", "--disturbance", "rest.csv"], "--disturbance: got 1 channel, expected 2"),
    (["run", "illustrative", "--driver", "mild"], "--driver: got it for 'illustrative', whose disturbance is"),
    (["run", "wind_turbine", "--driver", "mild"], "expected a study that declares a road, such as suspension"),
    (["run", "dc_servo", "--road", "road.csv", "--speed", "speed.csv"], "--road: got it for 'dc_servo'"),
    (["run", "half_car", "--driver", "mild"], "--driver: got it for 'half_car'"),
    (["run", "pendulum_on_cart", "--speed", "10"], "--speed: got it for 'pendulum_on_cart'"),
    (["run", "pendulum_on_cart", "--road", "no.csv"], "--road: got it for 'pendulum_on_cart'"),
    (["codesign", "illustrative", "--x0=9,9"], "--x0: got [9.0, 9.0], which is outside X"),
    (["codesign", "illustrative", "--x0=a"], "--x0: got 'a', expected finite numbers"),
    (["codesign", "Illustrative"], "Did you mean illustrative?"),
    ([*RUN, "--column", "dz_dt"], "--column: got it without --disturbance"),
    # Roads
    ([*RUN, "--road", "road.csv"], "--road: got it without --speed"),
    ([*RUN, "--speed", "speed.csv"], "--speed: got it without --road"),
    ([*RUN, "--road", "no.csv", "--speed", "speed.csv"], "--road: got 'no.csv', which is not a file"),
    ([*RUN, "--road", "road.csv", "--speed", "no.csv"], "--speed: got 'no.csv', which is not a file"),
    ([*RUN, "--road", "road.csv", "--speed", "speed.csv", "--driver", "mild"], "--driver: got it together with --road"),
    ([*RUN, "--disturbance", "times.csv", "--driver", "mild"], "--driver: got it together with --disturbance"),
    ([*RUN, "--disturbance", "times.csv", "--speed", "speed.csv"], "--speed: got it together with --disturbance"),
    ([*RUN, "--road", "back.csv", "--speed", "speed.csv"], "--road: got back.csv"),
    ([*RUN, "--road", "speed.csv", "--speed", "road.csv"], "--road: got speed.csv"),
    ([*RUN, "--road", "road.csv", "--speed", "reverse.csv"], "--speed: got reverse.csv"),
    ([*RUN, "--road", "road.csv", "--speed", "blink.csv"], "--speed: got 0.01 s"),
    ([*RUN, "--road", "road.csv", "--speed", "afar.csv"], "--road: got a road of 1999 m"),
    # Folders
    ([*RUN, "--output", ""], "--output: got ''"),
    ([*RUN, "--output", "note.txt"], "--output: got note.txt, which exists"),
    ([*RUN, "--output", "place.py"], "--output: got place.py, which exists"),
    ([*RUN, "--output", "place.py", "--overwrite"], "--output: got place.py, which holds no run"),
    ([*RUN, "--output", "note.txt", "--overwrite"], "--output: got note.txt, which holds no run"),
    ([*RUN, "--output", "note.txt/run"], "--output: got note.txt/run, expected a folder that can be made"),
    ([*RUN, "--output", "n" * 300], "expected a folder that can be made (File name too long)"),
    ([*RUN, "--output", "a\0b"], "--output: got"),
    (["resume"], "folder: got nothing, expected the folder of a run"),
    (["resume", "nowhere"], "folder: got nowhere, which is no folder"),
    (["resume", "note.txt"], "folder: got note.txt, which is no folder"),
    (["resume", "place.py"], "folder: got place.py without a readable run.json"),
    # New studies
    (["new"], "name: got nothing, expected a name for the study file"),
    (["new", "a"], "name: got a.py, which exists"),
    (["new", "my study"], "name: got 'my study', expected letters, digits and underscores"),
    (["new", "../up"], "name: got '../up'"),
    (["new", "class"], "name: got 'class', expected a name that Python or an installed package does not use"),
    (["new", "numpy"], "name: got 'numpy'"),
    (["new", "ccdtools"], "name: got 'ccdtools'"),
    (["new", "1st"], "name: got '1st'"),
    (["new", ""], "name: got ''"),
]


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with files that are wrong in every way."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "latin.csv").write_bytes(b"dz_dt\n0.1\n" + b"\xe9\n")
    road = 1000 * np.random.default_rng(0).standard_normal(600) * 0.3
    (tmp_path / "mm.csv").write_text("dz_dt\n" + "\n".join(f"{value:.1f}" for value in road) + "\n")
    (tmp_path / "place.py").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.long
@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=[" ".join(a)[:60].replace("\0", "0") for a, _ in WRONG])
def test_a_wrong_command_line_is_one_clear_line(place, monkeypatch, capsys, arguments, message):
    before = sorted(os.listdir(place))
    monkeypatch.setattr(sys, "argv", ["ccdtools", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    error = capsys.readouterr().err
    assert stopped.value.code == 2, error
    assert message in error
    assert len(error.strip().splitlines()) == 1
    assert error.startswith("ccdtools: ")
    assert ": got " in error
    assert sorted(os.listdir(place)) == before


def test_there_are_at_least_93_of_them():
    assert len(WRONG) >= 93
    assert len({tuple(arguments) for arguments, _ in WRONG}) == len(WRONG)


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["run", "-h"], [], ["--version"]])
def test_help_and_version_are_answered(monkeypatch, capsys, arguments):
    monkeypatch.setattr(sys, "argv", ["ccdtools", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 0
    assert "ccdtools" in capsys.readouterr().out


def ccdtools(*arguments, cwd, **environment):
    """The command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "ccdtools", *arguments], cwd=cwd, capture_output=True, timeout=120,
        env=os.environ | environment,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["run", "suspension", "--preset", "papr"], "--preset: got 'papr'"),
        (["codesign", "suspension", "--methods", "nested-lq"], "--methods: got 'nested-lq', expected one of"),
    ],
)
def test_a_wrong_option_is_answered_before_anything_slow_is_imported(tmp_path, arguments, message):
    code = (
        f"import sys; sys.argv = ['ccdtools', *{arguments}]\n"
        "import ccdtools.cli\n"
        "try:\n    ccdtools.cli.main()\nexcept SystemExit: pass\n"
        "print(sorted({'torch', 'casadi', 'matplotlib', 'scipy.signal'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == "[]"
    assert message in done.stderr


@pytest.mark.check
def test_a_terminal_without_unicode_gets_plain_characters(tmp_path):
    done = ccdtools("run", "suspension", "--p0=1e4,5000", cwd=tmp_path, PYTHONIOENCODING="cp1252")
    assert done.returncode == 2
    done = ccdtools("run", "--help", cwd=tmp_path, PYTHONIOENCODING="ascii")
    assert done.returncode == 0
    assert b"Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("encoding", "text"),
    [("ascii", "cost -23 % (84 -> 64) 7.85*10^-5 1.2*10^12"), ("latin-1", "cost -23 % (84 -> 64) 7.85·10^-5")],
)
def test_what_an_encoding_lacks_is_written_in_plain_characters(encoding, text):
    plain_where_needed()
    given = "cost −23 % (84 → 64) 7.85·10⁻⁵ 1.2·10¹²"
    assert given.encode(encoding, errors="ccdtools.plain").decode(encoding).startswith(text)


def test_an_output_that_nobody_reads_is_no_traceback(tmp_path):
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full here")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(
            [sys.executable, "-m", "ccdtools", "--help"], cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, timeout=60
        )
    assert done.returncode != 0
    assert b"Traceback" not in done.stderr


def test_the_module_runs_like_the_command(tmp_path):
    done = ccdtools("run", "nothing", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.decode().startswith("ccdtools: study: got 'nothing'")
