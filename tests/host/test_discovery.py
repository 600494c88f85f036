"""Discovery of ports and served twins."""

import subprocess
from pathlib import Path

import pytest
from forked import Forked, run_python
from serial.tools import list_ports
from served_twin import LISTS_PORTS, served

from khep_twin.cli import completion
from khep_twin.errors import PortInUse, PortTimeout
from khep_twin.host import Khepera, opening
from khep_twin.host.discovery import FoundPort, found_ports, identify_robot
from khep_twin.ports.event_sources import Event, open_events
from khep_twin.ports.negotiation import HIGHEST_BAUD


@pytest.fixture(autouse=True)
def private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A private directory of this test, on a machine without serial ports."""
    monkeypatch.setattr(list_ports, "comports", list[object])
    (tmp_path / "runtime").mkdir(mode=0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    return tmp_path


def twins() -> dict[str, str]:
    return {port.url: port.description for port in found_ports() if port.twin}


def test_a_served_twin_is_found_until_it_is_killed(private: Path) -> None:
    link = private / "khepera"
    with served("obstacles", "--link", str(link)) as (process, _):
        with served("two-lamps", "--tcp", ":0") as (_, url):
            assert twins() == {str(link): "twin in obstacles", url: "twin in two-lamps"}
        process.kill()
        process.wait()
        assert twins() == {}
    with served("default") as (_, path):
        assert list(twins()) == [path]
        assert len(list((private / "runtime" / "khep_twin").glob("*.served"))) == 1


def test_the_old_name_of_a_ports_description_warns() -> None:
    port = FoundPort("/dev/ttyUSB0", "serial port", twin=False)
    with pytest.warns(DeprecationWarning, match="expected 'description'"):
        assert port.what == port.description


def test_the_command_lists_and_asks() -> None:
    def run_ports(*options: str) -> subprocess.CompletedProcess[str]:
        command = [*LISTS_PORTS, *options]
        return run_python(command)

    with served("default", "--mode", "2", "--strict-line") as (_, path):
        assert f"{path}  twin in default\n" in run_ports().stdout
        assert (
            f"{path}  twin in default: BIOS 5.02, protocol 5.01 at 19200 baud\n"
            in run_ports("--probe").stdout
        )


@pytest.mark.share(3)
@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
@pytest.mark.parametrize("options", ["", "--tcp :0", "--rfc2217 :0"])
def test_asking_leaves_a_running_session_undisturbed(options: str) -> None:
    command = [*LISTS_PORTS, "--probe"]
    with served("default", *options.split()) as (process, url):
        with Khepera(url) as robot:
            probe = Forked(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            n_exchanges = 0
            while probe.poll() is None:
                robot.set_position(n_exchanges, -n_exchanges)
                assert robot.position() == (n_exchanges, -n_exchanges)
                n_exchanges += 1
            output, errors = probe.communicate()
        assert n_exchanges > 0
        assert f"{url}  twin in default: in use by " in output
        assert errors == ""
        # With the host gone it is asked.
        free = run_python(command)
        assert f"{url}  twin in default: BIOS 5.02, protocol 5.01 at 9600 baud\n" in free.stdout
        process.terminate()
        assert process.stderr is not None
        notices = [
            line for line in process.stderr.read().splitlines() if line.startswith(f"khep-twin: {url}: ")
        ]
    assert notices == []


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")
def test_a_speed_that_the_port_refuses_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    with served("default", "--mode", "3", "--strict-line", "--rfc2217", ":0") as (_, url):
        monkeypatch.setattr(opening, "BAUD_RATES", (HIGHEST_BAUD + 1, 38400))
        with Khepera(url, baudrate="auto") as robot:
            assert robot.port.baudrate == 38400
        monkeypatch.setattr(opening, "BAUD_RATES", (HIGHEST_BAUD + 1,))
        with pytest.raises(PortTimeout, match=r"no answer to 'B' at any baud.* refuses 4000001 baud"):
            Khepera(url, baudrate="auto")


def test_looking_for_ports_opens_none_of_them() -> None:
    with served("default") as (_, path):
        events = open_events(path)
        if events is None:
            pytest.skip("there is no inotify here")
        assert run_python([*LISTS_PORTS]).returncode == 0
        assert path in dict(completion.ports())
        assert path in twins()
        assert events.drain() == []
        with Khepera(path):
            events.drain()
            assert run_python([*LISTS_PORTS, "--probe"]).returncode == 0
            assert path in dict(completion.ports())
            assert Event.OPENED not in events.drain()
        events.close()


def test_asking_leaves_a_robots_port_alone_that_is_relayed() -> None:
    with served("default") as (_, device):
        with served("--relay", device) as (_, path), Khepera(path) as robot:
            with pytest.raises(PortInUse, match=f"{device}: in use by process "):
                identify_robot(device)
            assert robot.versions().bios == "5.02"
