"""Programs are scored in challenges from a page in a real browser."""

from pathlib import Path

from tests.web.test_page_challenges import DRIVES, FAILS, WAITS
from tests.web.visit import BROWSED, Visit, need_a_browser

need_a_browser()
pytestmark = BROWSED


def test_programs_are_scored_stopped_and_listed_and_a_failing_line_is_marked(
    visit: Visit, tmp_path: Path
) -> None:
    page = visit.page
    (tmp_path / "class").mkdir()
    for name, text in (("drives", DRIVES), ("class/fails", FAILS), ("waits", WAITS)):
        (tmp_path / f"{name}.py").write_text(text)
    page.click('[data-tab="challenge"]')
    page.wait_for_selector("#challenge-picture:not([hidden])")
    page.select_option("#challenge", "maze")
    page.wait_for_selector("#challenge-facts >> text=4 runs of 40 s")
    page.click("#challenge-playpen")
    visit.wait("document.querySelectorAll('.kind-lamp').length === 2")

    # By the keyboard alone; what the program prints appears, then its scores.
    page.select_option("#challenge", "stop")
    page.select_option("#scored", "drives.py")
    page.focus("#score")
    page.keyboard.press("Enter")
    page.wait_for_selector("#score-printed >> text=driven")
    page.wait_for_selector("#score-status.failed >> text=drives.py: failed")
    assert page.inner_text("#score-runs").splitlines()[0].startswith("run 1")
    assert "at least 0.5 of the time" in page.inner_text("#score-runs")
    visit.wait("!document.querySelector('#score').disabled")
    visit.picture("14-challenge")

    # A page that is loaded again can stop what is being scored.
    page.select_option("#scored", "waits.py")
    page.click("#score")
    page.wait_for_selector("#score-printed >> text=here")
    visit.open()
    page.click('[data-tab="challenge"]')
    visit.wait("!document.querySelector('#scored-stop').disabled")
    page.keyboard.press("Escape")
    page.wait_for_selector("#score-status >> text=stopped")
    visit.wait("!document.querySelector('#score').disabled")

    page.select_option("#challenge", "stop")
    page.select_option("#score-folder", "class")
    page.click("#score-table")
    page.wait_for_selector("#score-rows tbody >> text=class/fails.py:3: NameError")
    with page.expect_download() as download:
        page.click("#score-csv")
    assert download.value.suggested_filename == "stop.csv"
    assert (
        download.value.path().read_text().splitlines()[1].startswith(",fails,,,class/fails.py:3: NameError")
    )
    visit.wait("!document.querySelector('#score').disabled")

    # The line at which a program fails is marked where it is open.
    page.click('[data-tab="run"]')
    page.select_option("#controller", "class/fails.py")
    page.click("#edit")
    visit.wait("document.querySelector('#code').value.includes('nonsense')")
    page.click('[data-tab="challenge"]')
    page.select_option("#scored", "class/fails.py")
    page.click("#score")
    page.wait_for_selector("#lines .failed >> text=3")
    assert page.inner_text("#program-status").startswith("class/fails.py:3: NameError")
