"""The notebooks run from the first cell to the last, and their cells have no output in the repository."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))

WIDGET = "application/vnd.jupyter.widget-view+json"

pytestmark = [
    # jupyter_client tells about its own transport, and of event loops of other libraries.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, 4)


def outputs(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


@pytest.fixture(scope="module")
def ended(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> nbformat.NotebookNode:
    """A notebook after its last cell; an error of a cell is raised here."""
    notebook = read(request.param)
    folder = {"metadata": {"path": str(tmp_path_factory.mktemp("notebook"))}}
    NotebookClient(notebook, timeout=300, kernel_name="python3", resources=folder).execute()
    return notebook


def test_there_are_three() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["01_first_drive", "02_sensor_model", "03_evolve"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    assert not outputs(notebook)
    assert all(cell.execution_count is None for cell in notebook.cells if cell.cell_type == "code")


@pytest.mark.long
@pytest.mark.parametrize("ended", NOTEBOOKS[:1], ids=["01_first_drive"], indirect=True)
def test_the_first_drive_shows_the_twin_and_both_controllers(ended: nbformat.NotebookNode) -> None:
    pytest.importorskip("rerun_notebook", reason="rerun-notebook, the extra [notebook], is not installed")
    widgets = [cell_output for cell_output in outputs(ended) if WIDGET in cell_output.get("data", {})]
    assert any("rerun_notebook" in cell_output.data["text/plain"] for cell_output in widgets)
    shares = [
        float(cell_output.data["text/plain"]) for cell_output in outputs(ended) if _is_share(cell_output)
    ]
    assert len(shares) == 2
    assert all(0 <= share < 0.5 for share in shares)


@pytest.mark.long
@pytest.mark.parametrize("ended", NOTEBOOKS[1:2], ids=["02_sensor_model"], indirect=True)
def test_the_sensor_model_has_its_curve_and_threshold(ended: nbformat.NotebookNode) -> None:
    text = "".join(cell_output.get("text", "") for cell_output in outputs(ended))
    match = re.search(r"sd (\d+) counts .*\n300 counts at (\d+) mm", text)
    assert match is not None, text
    assert 5 < int(match[1]) < 40
    assert 20 < int(match[2]) < 30
    assert any("image/png" in cell_output.get("data", {}) for cell_output in outputs(ended))


@pytest.mark.long
@pytest.mark.parametrize("ended", NOTEBOOKS[2:], ids=["03_evolve"], indirect=True)
def test_the_evolved_network_drives_in_mujoco_as_in_the_plane(ended: nbformat.NotebookNode) -> None:
    text = "".join(cell_output.get("text", "") for cell_output in outputs(ended))
    match = re.search(r"fitness (\S+) in the plane, (\S+) in MuJoCo", text)
    assert match is not None, text
    assert float(match[1]) > 0.1
    assert abs(float(match[1]) - float(match[2])) < 0.1
    assert sum("image/png" in cell_output.get("data", {}) for cell_output in outputs(ended)) == 2


def _is_share(output: nbformat.NotebookNode) -> bool:
    return re.fullmatch(r"0(\.\d+)?|0", output.get("data", {}).get("text/plain", "")) is not None
