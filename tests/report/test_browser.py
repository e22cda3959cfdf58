"""Reports in a real browser."""

import base64
import time

import pytest

from tests.browser import browser, complaints, open_file
from tests.study.folders import write_study

for package in ("pyarrow", "scipy", "vl_convert"):
    pytest.importorskip(package, reason="reports need the extra 'study'")

ARMS = {"ippo": ("ippo", 0.4), "dynamic": ("belief_ppo", 0.8), "static": ("belief_ppo", 0.4)}
DRAWN = "return document.querySelectorAll('[data-drawn]').length"


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    from sb3_belief.study.reporting import ReportOptions, write_report

    folder = tmp_path_factory.mktemp("studies") / "games"
    write_study(folder, ARMS, ["junction", "lbf/forest-v3"], n_seeds=3, ablations={"Parts": ["ippo", "dynamic"]})
    return write_report(ReportOptions(str(folder)))[0]


@pytest.fixture(scope="module")
def wide():
    with browser() as driver:
        yield driver


@pytest.fixture
def driver(wide, report):
    open_file(wide, report)
    wide.execute_script("localStorage.clear()")
    open_file(wide, report)
    yield wide
    assert complaints(wide) == []
    assert wide.execute_script("return performance.getEntriesByType('resource').map((entry) => entry.name)") == []


def wait_for(condition, seconds=20):
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.05)
    return value


def find(driver, selector):
    return driver.find_elements("css selector", selector)


def column(driver, number, table="results"):
    rows = [row for row in find(driver, f"#table-{table} tbody tr") if row.is_displayed()]
    return [row.find_elements("css selector", "th, td")[number].text for row in rows]


def test_it_opens_at_once_and_draws_what_is_looked_at(driver):
    timing = driver.execute_script("return performance.getEntriesByType('navigation')[0].loadEventEnd")
    assert 0 < timing < 3000
    assert driver.title == "games" and find(driver, "#quote")[0].is_displayed()
    # Pictures stand there before, so that nothing is empty
    assert all(find(driver, ".drawing svg"))
    driver.execute_script("document.getElementById('curves').scrollIntoView()")
    wait_for(lambda: find(driver, "[data-drawn='learning-junction'] svg"))
    assert driver.execute_script(DRAWN) < len(find(driver, "figure"))


def test_tables_sort_and_filter(driver):
    def press(label):
        (button,) = [each for each in find(driver, "#table-results thead button") if each.text == label]
        button.click()
        return button.find_element("xpath", "..").get_attribute("aria-sort")

    unsorted = column(driver, 2)
    assert press("IQM") == "ascending" and column(driver, 2) == sorted(unsorted, key=float)
    assert press("IQM") == "descending" and column(driver, 2) == sorted(unsorted, key=float, reverse=True)
    assert press("algorithm") == "ascending" and column(driver, 1) == sorted(column(driver, 1))
    states = [head.get_attribute("aria-sort") for head in find(driver, "#table-results thead th")]
    assert states.count("ascending") == 1 and states.count("none") == len(states) - 1
    # What is not there stands last both ways
    for _ in range(2):
        press("p (Holm)")
        assert column(driver, 8)[-3:] == ["–"] * 3  # noqa: RUF001
    (box,) = find(driver, "#table-results input")
    box.send_keys("junction dyn")
    assert column(driver, 1) == ["dynamic"] and find(driver, "#table-results .count")[0].text == "1 of 9 rows"
    for _ in range(12):
        box.send_keys("\b")
    assert len(column(driver, 1)) == 9


def test_the_theme_is_switched_and_remembered(driver, report):
    def ground():
        return driver.execute_script("return getComputedStyle(document.body).backgroundColor")

    def label():
        colour = driver.execute_script("return getComputedStyle(document.querySelector('.drawing text')).fill")
        return colour, find(driver, "#theme")[0].text

    first, letters = ground(), label()
    find(driver, "#theme")[0].click()
    assert ground() != first and label() != letters
    second = ground()
    open_file(driver, report)
    assert ground() == second
    find(driver, "#theme")[0].click()
    assert (ground(), label()) == (first, letters)


def test_the_pointer_tells_the_seed_and_algorithms_can_be_hidden(driver):
    from selenium.webdriver import ActionChains

    driver.execute_script("document.getElementById('curves').scrollIntoView()")
    drawing = wait_for(lambda: find(driver, "[data-drawn='learning-junction'] svg"))[0]
    ActionChains(driver).move_to_element(drawing).perform()

    def told():
        return [row.text for row in find(driver, "#vg-tooltip-element tr") if row.text]

    lines = dict(
        line.split(" ", 1) if not line.startswith(("joint", "success")) else line.rsplit(" ", 1) for line in wait_for(told)
    )
    assert lines["algorithm"] in ARMS and lines["seed"] in "012" and 0 <= float(lines["success rate"]) <= 1
    paths = len(find(driver, "[data-drawn='learning-junction'] svg path[stroke='var(--arm-1)']"))
    (button, *_) = find(driver, "#curves .legend button[data-arm='dynamic']")
    button.click()
    assert {each.get_attribute("aria-pressed") for each in find(driver, ".legend button[data-arm='dynamic']")} == {"false"}
    wait_for(lambda: len(find(driver, "[data-drawn='learning-junction'] svg path[stroke='var(--arm-1)']")) < paths)


def test_it_prints(driver):
    pdf = base64.b64decode(driver.print_page())
    assert pdf.startswith(b"%PDF") and len(pdf) > 50_000


@pytest.fixture(scope="module")
def phone():
    with browser(390, 844, phone=True) as driver:
        yield driver


def test_a_phone_scrolls_in_one_direction_only(phone, report):
    run = next((report.with_name("report_files") / "runs").glob("dynamic-*.html"))
    for path in (report, run):
        open_file(phone, path)
        for _ in range(2):
            wider = phone.execute_script("return document.documentElement.scrollWidth - innerWidth")
            assert wider <= 0, path.name
            phone.execute_script("document.querySelector('#curves figure').scrollIntoView()")
            wait_for(lambda: phone.execute_script(DRAWN))
        assert complaints(phone) == []
    open_file(phone, report)
    sizes = phone.execute_script(
        "return [...document.querySelectorAll('p, td')].map((e) => parseFloat(getComputedStyle(e).fontSize))"
    )
    assert min(sizes) >= 12


def test_a_run_s_page_draws_its_belief(driver, report):
    run = next((report.with_name("report_files") / "runs").glob("dynamic-*.html"))
    open_file(driver, run)
    driver.execute_script("document.getElementById('belief').scrollIntoView()")
    wait_for(lambda: find(driver, "[data-drawn='belief-accuracy'] svg"))
    names = driver.execute_script(
        "return performance.getEntriesByType('resource').map((entry) => entry.name.split('/').pop())"
    )
    assert names in ([], ["vega.js"])
    open_file(driver, report)
