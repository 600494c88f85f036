"""Studies: read strictly, and made into tasks."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from khep_twin.episodes.controllers import Function, Network
from khep_twin.errors import StudyError
from khep_twin.sweep import study as studies
from khep_twin.sweep.programs import driver_of
from khep_twin.sweep.shards import work_of

STUDY = """version = 1
name = "mine"
playpens = ["default"]
controllers = ["braitenberg"]
seeds = 3
seconds = 0.2
step_ms = 10
rollouts_per_task = 4
output = "out"
"""


def loaded(folder: Path, text: str) -> studies.StudyFile:
    file = folder / "study.toml"
    file.write_text(text)
    return studies.load(file)


def test_keys_of_a_study_that_are_also_in_its_grid_are_reported_in_order(tmp_path: Path) -> None:
    keys = "line_baud", "period_ms", "seconds", "step_ms"
    text = STUDY.replace("step_ms", "line_baud = 0\nperiod_ms = 20\nstep_ms")
    with pytest.raises(StudyError) as caught:
        loaded(
            tmp_path, text + "[grid]\nline_baud = [0]\nperiod_ms = [20]\nseconds = [0.2]\nstep_ms = [10]\n"
        )
    assert tuple(problem.location[-1] for problem in caught.value.problems) == keys


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("seeds = 3", "seeds = 0", r"study.toml:5: seeds = 0; expected an integer from 1"),
        ("seeds = 3", "seeds = 3\nsed = 1", r"study.toml:6: sed = 1: unknown key; did you mean 'seeds'"),
        ("seconds = 0.2", "seconds = 0.21", r"study.toml:6: seconds = 0.21; expected whole .* of 20 ms"),
        ("step_ms = 10", "step_ms = 3", r"study.toml:7: step_ms = 3; expected 2.5, 5 or 10"),
        ("step_ms = 10", 'device = "cuda"', r"study.toml:7: device = \"cuda\": .*; expected planar = true"),
        ("step_ms = 10", 'device = "gpu"', r"study.toml:7: device = \"gpu\": unknown; did you mean 'cpu'"),
        ('["default"]', '["default", "default"]', r"study.toml:3: playpens has \"default\" twice"),
        ('["default"]', '["defualt"]', r"study.toml:3: playpens: \"defualt\": .*no such file"),
        ('["default"]', '["gripper"]\nplanar = true', r"study.toml:3: playpens: \"gripper\": .*turrets"),
        ('["braitenberg"]', '["mine"]', r"study.toml:4: controllers.*\"mine\": unknown; .*braitenberg"),
        ('controllers = ["braitenberg"]', "", r"no controller; expected controllers, a \[\[network\]\]"),
        ("", 'fitness = ["homing"]\n', r"study.toml:10: fitness = \"homing\": there is no \[home\]"),
        ("", "[grid]\nnoise = []\n", r"study.toml:11: grid: noise; expected a list of true"),
        ("", "[grid]\nnoise = [true, -1]\n", r"study.toml:11: grid: noise 2 = -1; expected a list of true, "),
        ("", "[grid]\nnoise = [true, 1]\n", r"study.toml:11: noise has 1.0 twice; expected once"),
        ("", "[grid]\nplanar = [1]\n", r"study.toml:11: grid: planar 1 = 1; expected a list of true and"),
        ("", "[grid]\nline_baud = [-1]\n", r"study.toml:11: grid: line_baud 1 = -1; expected a list of num"),
        ("", "[grid]\nperiod_ms = []\n", r"study.toml:11: grid: period_ms; expected a list of multiples of"),
        (
            "",
            "[grid]\nseconds = [1]\n",
            r"study.toml:11: grid: seconds: is a key of the study, too; expected o",
        ),
        (
            'step_ms = 10\nrollouts_per_task = 4\noutput = "out"\n',
            'output = "out"\n[grid]\nstep_ms = [5, 3]',
            r"study.toml:9: step_ms = 3; expected 2.5, 5 or 10",
        ),
        ("seconds = 0.2", "", r"study.toml: seconds is missing; expected the duration of an episode"),
        ("", "[grid]\nperiod_ms = [20, 30]\n", r"study.toml:6: seconds = 0.2; expected whole .* of 30 ms"),
        ("", 'device = "cuda"\n[grid]\nplanar = [true, false]\n', r"study.toml:10: device = .*: episodes in"),
        ("", '[grid]\nstarts = ["1,2,3"]\n', r"study.toml:11: starts, in default: start 1,2,3: "),
        ("", '[[network]]\nname = "n"\n', r"study.toml:10: network 1: has neither of genomes"),
        (
            "",
            '[[network]]\nname = "braitenberg"\ndrawn = 2\n',
            r"study.toml:11: network 1: name = \"braitenberg\": taken",
        ),
        (
            "",
            '[[network]]\nname = "n"\ngenomes = "few.csv"\n',
            r"study.toml:12: network 1: genomes = \"few.csv\": shape \(2, 3\); expected rows of 18 ",
        ),
        (
            "",
            '[[network]]\nname = "n"\ngenomes = "none.npy"\n',
            r"study.toml:12: network 1: genomes = \"none.npy\": cannot be read: No such file",
        ),
        (
            "",
            '[[network]]\nname = "n"\ngenomes = "zip.npy"\n',
            r"study.toml:12: network 1: genomes = \"zip.npy\": cannot be read: the magic string is not",
        ),
        (
            "",
            '[[program]]\nname = "n"\nfile = "mine.py:steer"\ngenomes = "nan.csv"\n',
            r"study.toml:13: program 1: genomes = \"nan.csv\": NaN or infinity; expected finite",
        ),
        (
            "",
            '[[program]]\nname = "n"\nfile = "mine.py:stear"\n',
            r"study.toml:12: program 1: file = .*no function 'stear'; did you mean 'steer'",
        ),
    ],
)
def test_a_mistake_is_reported_by_file_line_key_and_value(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    (tmp_path / "few.csv").write_text("1,2,3\n4,5,6\n")
    (tmp_path / "zip.npy").write_bytes(b"PK" + bytes(200))
    (tmp_path / "nan.csv").write_text("1,nan\n")
    (tmp_path / "mine.py").write_text("def steer(proximity, ambient, memory, genes):\n    return 1.0, 1.0\n")
    assert old in STUDY
    with pytest.raises(StudyError, match=message) as error:
        work_of(loaded(tmp_path, STUDY.replace(old, new) if old else STUDY + new))
    assert "\n" not in str(error.value)


def test_there_is_a_episode_for_each_point_of_the_grid_genome_and_seed_in_tasks_of_one_kind(
    tmp_path: Path,
) -> None:
    grid = '[grid]\nnoise = [true, false]\nstarts = ["playpen", "grid:2x2"]\n'
    grid += '[[network]]\nname = "drawn"\nhidden = [2]\ndrawn = 5\n'
    work = work_of(loaded(tmp_path, STUDY + grid))
    # Two controllers with 1 and 5 genomes, five starts, three seeds, with and without noise.
    assert work.n_episodes == (1 + 5) * 5 * 3 * 2
    assert [task.index for task in work.tasks] == list(range(len(work.tasks)))
    numbers = [number for task in work.tasks for number in range(task.first, task.first + task.count)]
    assert numbers == list(range(work.n_episodes))
    assert max(task.count for task in work.tasks) == 4


def test_each_parameter_can_be_a_list_in_the_grid_and_its_last_one_varies_fastest(tmp_path: Path) -> None:
    study = STUDY.replace("seconds = 0.2\n", "").replace("step_ms = 10\n", "")
    grid = "[grid]\nnoise = [true, 0.5]\nplanar = [false, true]\nline_baud = [0, 9600]\n"
    points = [
        group.point for group in work_of(loaded(tmp_path, f"{study}{grid}seconds = [0.2, 0.4]\n")).groups
    ]
    assert [(p.noise, p.planar, p.line_baud, p.seconds) for p in points] == list(
        itertools.product((1.0, 0.5), (False, True), (0, 9600), (0.2, 0.4))
    )
    assert [(point.step_ms, point.period_ms) for point in points[::4]] == [(2.5, 20), (10.0, 20)] * 2
    default = work_of(loaded(tmp_path, STUDY)).groups[0].point
    assert default == studies.Point(True, False, "all", False, 0, 10.0, 20, 0.2)
    assert default.noise is True


def test_genomes_come_from_files_beside_the_study_or_are_drawn_by_a_seed(tmp_path: Path) -> None:
    rows = np.random.default_rng(1).normal(size=(2, 18))
    np.save(tmp_path / "a.npy", rows)
    np.savetxt(tmp_path / "b.csv", rows, delimiter=",", fmt="%.17g")
    networks = '[[network]]\nname = "a"\ngenomes = "a.npy"\n[[network]]\nname = "b"\ngenomes = "b.csv"\n'
    networks += '[[network]]\nname = "c"\ndrawn = 4\n[[network]]\nname = "d"\ndrawn = 4\ndrawn_seed = 1\n'
    _, a, b, c, d = (
        controller.genomes for controller in work_of(loaded(tmp_path, STUDY + networks)).controllers
    )
    assert a.tobytes() == b.tobytes() == rows.tobytes()
    assert c.shape == d.shape == (4, 18)
    assert not np.isclose(c, d).any()
    again = work_of(loaded(tmp_path, STUDY + networks)).controllers
    assert again[3].genomes.tobytes() == c.tobytes()


FOUR = """version = 1
name = "four"
playpens = ["arena4", "arena4-room"]
seeds = 1
seconds = 1
output = "out"
[[network]]
name = "drawn"
drawn = 2
terms = ["ultrasonic"]
[[program]]
name = "own"
file = "own.py:steer"
"""


def test_controllers_of_a_study_are_of_its_playpens_model(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text("def steer(proximity, ambient, memory, genes, ground, gain=1): ...")
    network, program = (driver_of(each.driver) for each in work_of(loaded(tmp_path, FOUR)).controllers)
    assert network == Network(model="khepera4", terms=("ultrasonic",))
    assert isinstance(program, Function)
    assert program.terms == ("ground",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"arena4-room"', '"default"', "study.toml:3: playpens: robots of the models khepera4, khepera"),
        ('["ultrasonic"]', '["sonar"]', "study.toml:10: network 1: terms: model khepera4: term 'sonar': unk"),
        ("drawn = 2", "drawn = 2\ntop_speed_pulses = 4e4", "study.toml:10: .* = 40000; expected .* to 32767"),
        ("own.py:steer", "own.py:late", "study.toml:13: program 1: file = \".*term 'odour': unknown"),
        ("seeds", 'controllers = ["braitenberg"]\nseeds', "study.toml:4: .*braitenberg.*expected a Khepera"),
    ],
)
def test_a_controller_of_another_model_in_a_study_is_refused(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "own.py").write_text(
        "def steer(proximity, ambient, memory, genes): ...\ndef late(a, b, c, d, odour): ..."
    )
    with pytest.raises(StudyError, match=message):
        work_of(loaded(tmp_path, FOUR.replace(old, new)))


def test_work_is_distinguished_by_everything_but_the_folder_of_its_results(tmp_path: Path) -> None:
    changes = [
        ("", ""),
        ('"out"', '"elsewhere"'),
        ("seeds = 3", "seeds = 4"),
        ('["default"]', '["obstacles"]'),
        ("step_ms = 10", "step_ms = 10\nline_baud = 9600"),
    ]
    digests = [work_of(loaded(tmp_path, STUDY.replace(*change))).digest for change in changes]
    assert digests[0] == digests[1]
    assert len({*digests}) == 4


def test_the_study_of_the_page_is_as_large_as_it_says(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "sweep.md").read_text()
    text = page.partition("```toml\n")[2].partition("```")[0]
    work = work_of(loaded(tmp_path, text))
    assert f"noise: {work.n_episodes} episodes of 20 s in {len(work.tasks)} tasks" in page


def test_what_a_plane_cannot_have_is_refused_before_any_episode(tmp_path: Path) -> None:
    text = (studies.toml_files.folder("playpens") / "default.toml").read_text()
    movable = "\n[[cylinder]]\nx_mm = 400\ny_mm = 100\nradius_mm = 7\nheight_mm = 30\nmovable = true\n"
    (tmp_path / "loose.toml").write_text(text + movable)
    study = STUDY.replace('"default"', '"loose.toml"')
    assert work_of(loaded(tmp_path, study)).n_episodes == 3
    with pytest.raises(StudyError, match=r"study.toml:3: playpens: .*cylinder 1 is movable, 14 mm wide"):
        work_of(loaded(tmp_path, study + "planar = true\n"))


def test_each_value_in_a_networks_file_changes_the_fingerprint(tmp_path: Path) -> None:
    genes = np.zeros(18)
    variants = {
        "plain": (Network(), genes),
        "one gene": (Network(), np.eye(1, 18)[0]),
        "top speed": (Network(top_speed=10.0), genes),
        "period": (Network(period_ns=40_000_000), genes),
        "light": (Network(ambient=True), np.zeros(34)),
    }
    digests = set[str]()
    for network, network_genes in variants.values():
        network.save(tmp_path / "best.npz", network_genes, replace=True)
        text = STUDY.replace("braitenberg", "best.npz")
        if network.period_ns == 40_000_000:
            text = text.replace("step_ms = 10", "step_ms = 10\nperiod_ms = 40")
        digests.add(work_of(loaded(tmp_path, text)).digest)
    assert len(digests) == len(variants)
