"""The viewer in a real browser."""

import time

import pytest

from sb3_belief.report.viewer.page import write_viewer
from sb3_belief.report.viewer.page_data import page_data
from tests.browser import browser, complaints, open_file
from tests.report.recorded import LIMIT, SPACES, recorded, trained

SPEEDS = "return document.getElementById('speed').value = '16'"


@pytest.fixture(scope="module")
def recording():
    return recorded(*trained(), episodes=2)


@pytest.fixture(scope="module")
def page(recording, tmp_path_factory):
    return write_viewer(recording, tmp_path_factory.mktemp("viewer") / "viewer.html", "Every <i>kind</i>", "below & beside")


@pytest.fixture(scope="module")
def wide():
    with browser() as driver:
        yield driver


@pytest.fixture
def driver(wide, page):
    open_file(wide, page, "episode=1&step=0&agent=several")
    yield wide
    assert complaints(wide) == []


def find(driver, selector):
    return driver.find_elements("css selector", selector)


def text(driver, selector):
    (element,) = find(driver, selector)
    return element.text


def key(driver, name):
    from selenium.webdriver.common.keys import Keys

    find(driver, "body")[0].send_keys(getattr(Keys, name, name))


def shown_step(driver):
    return int(text(driver, "#step").split()[1])


def test_it_shows_the_numbers_of_the_step(driver, recording):
    data = page_data(recording, "")
    assert (text(driver, "h1"), text(driver, "#subtitle")) == ("Every <i>kind</i>", "below & beside")
    assert driver.execute_script("return document.getElementById('frame').naturalWidth") == 480
    for step in (0, 1):
        view = data["episodes"][0]["steps"][step]["views"]["several"]
        assert text(driver, "#step") == f"step {step} of {LIMIT}"
        # All are seen at even steps, and the first only at odd ones
        tags = [card.text for card in find(driver, "#others .card .tag")]
        verdicts = ["not seen" if right is None else "✓ right" if all(right) else "✗ wrong" for right in view["right"]]
        numbers = 2 if step == 0 else None
        assert [tag for k, tag in enumerate(tags) if k != numbers] == [word for k, word in enumerate(verdicts) if k != numbers]
        assert step == 1 or tags[2] == "seen"
        percents = [bar.text.split("\n")[-1] for bar in find(driver, '#others .card[data-other="discrete"] .bar')]
        assert percents == [f"{int(100 * p + 0.5)} %" for p in view["expects"][0]]
        assert "<b>left</b>" in text(driver, '#others .card[data-other="discrete"]')
        rows = [int(card.get_attribute("data-row")) for card in find(driver, "#memory .card")]
        assert rows == [row for row, _ in view["rows"]][: len(rows)] and rows
        find(driver, "#forward")[0].click()


def test_it_steps_by_buttons_keys_and_the_timeline(driver):
    for press, step in (
        ("ARROW_RIGHT", 1),
        ("END", LIMIT - 1),
        ("ARROW_RIGHT", LIMIT - 1),
        ("ARROW_LEFT", LIMIT - 2),
        ("HOME", 0),
    ):
        key(driver, press)
        assert shown_step(driver) == step
    find(driver, "#last")[0].click()
    assert shown_step(driver) == LIMIT - 1
    from selenium.webdriver import ActionChains

    lane = find(driver, "#timeline svg")[1]
    width = lane.size["width"]
    for step in (4, 1):
        ActionChains(driver).move_to_element_with_offset(
            lane, round(width * ((step + 0.5) / LIMIT - 0.5)), 0
        ).click().perform()
        assert shown_step(driver) == step
    assert find(driver, "#timeline")[0].get_attribute("aria-valuenow") == "1"


def test_it_plays_to_the_end_and_pauses(driver):
    driver.execute_script(SPEEDS)
    key(driver, " ")
    assert find(driver, "#play")[0].get_attribute("aria-label") == "Pause"
    until = time.monotonic() + 5
    while find(driver, "#play")[0].get_attribute("aria-label") == "Pause" and time.monotonic() < until:
        time.sleep(0.05)
    assert shown_step(driver) == LIMIT - 1 and find(driver, "#play")[0].get_attribute("aria-label") == "Play"
    # Then it plays from the start again, slowly, so that the end is not reached before the pause
    driver.execute_script(SPEEDS.replace("16", "1"))
    find(driver, "#play")[0].click()
    assert shown_step(driver) < LIMIT - 1
    key(driver, " ")
    stopped = shown_step(driver)
    time.sleep(1.2)
    assert shown_step(driver) == stopped


def test_another_agent_episode_and_address(driver, page):
    for agent in SPACES:
        find(driver, f'#agents [data-agent="{agent}"]')[0].click()
        assert f"What {agent} believes" in text(driver, "#others-title")
        assert find(driver, '#agents [aria-checked="true"]')[0].text == agent
        assert {track.get_attribute("data-name") for track in find(driver, ".track")} == {"reward", *SPACES, "clock"} - {agent}
    key(driver, "ARROW_DOWN")
    assert find(driver, '#agents [aria-checked="true"]')[0].text == "discrete"
    from selenium.webdriver.support.ui import Select

    Select(find(driver, "#episode")[0]).select_by_index(1)
    key(driver, "ARROW_RIGHT")
    key(driver, "ARROW_RIGHT")
    assert "not in play" in text(driver, "#status")
    assert driver.current_url.endswith("#episode=2&step=2&agent=discrete")
    open_file(driver, page, "episode=2&step=2&agent=discrete")
    assert shown_step(driver) == 2 and "not in play" in text(driver, "#status")


def test_clicking_an_agent_in_the_picture_chooses_it(driver):
    driver.execute_script("document.querySelector('#overlay .who').dispatchEvent(new MouseEvent('click', {bubbles: true}))")
    assert find(driver, '#agents [aria-checked="true"]')[0].text == "discrete"
    # At step 0 it sees the clock, and the picture tells both places
    assert len(find(driver, "#overlay .chosen.inner")) == 1 and len(find(driver, "#overlay .badge")) == 1


def test_it_has_two_themes(driver):
    def colours():
        return driver.execute_script("const s = getComputedStyle(document.body); return [s.backgroundColor, s.color]")

    before = colours()
    find(driver, "#theme")[0].click()
    dark = colours()
    assert dark != before
    key(driver, "t")
    assert colours() == before


def test_an_address_of_nonsense_opens_the_page(driver, page):
    open_file(driver, page, "episode=99&step=-3&agent=%3Cscript%3E")
    assert shown_step(driver) == 0
    open_file(driver, page, "episode=x&step=y&agent=constructor")
    assert find(driver, "#others .card")


def test_it_fits_a_phone(page):
    with browser(390, 800, phone=True) as driver:
        open_file(driver, page)
        assert driver.execute_script("return document.documentElement.scrollWidth <= window.innerWidth")
        assert driver.execute_script("return document.getElementById('figure').clientWidth") > 300
        find(driver, "#forward")[0].click()
        assert complaints(driver) == []


def test_the_head_stands_over_its_step(driver):
    place = "const box = document.querySelector(arguments[0]).getBoundingClientRect(); return [box.left, box.right]"
    for step in range(LIMIT):
        left, right = driver.execute_script(place, "#head")
        start, end = driver.execute_script(place, "#timeline svg")
        width = (end - start) / LIMIT
        assert (left, right) == pytest.approx((start + step * width - 2, start + (step + 1) * width + 2), abs=0.6)
        key(driver, "ARROW_RIGHT")


def test_it_prints_light(driver):
    find(driver, "#theme")[0].click()
    theme = driver.execute_script("return document.documentElement.dataset.theme")
    # A PDF in base64, of more than an empty page
    assert len(driver.print_page()) > 20_000
    assert driver.execute_script("return document.documentElement.dataset.theme") == theme
    driver.execute_script("window.dispatchEvent(new Event('beforeprint'))")
    assert driver.execute_script("return document.documentElement.dataset.theme") == "light"
    driver.execute_script("window.dispatchEvent(new Event('afterprint'))")
    assert driver.execute_script("return document.documentElement.dataset.theme") == theme
