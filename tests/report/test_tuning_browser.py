"""The report of a tuning in a real browser."""

import pytest

from tests.browser import browser, complaints, open_file
from tests.report.test_browser import column, find, wait_for
from tests.study.folders import write_tuning

for package in ("pyarrow", "scipy", "vl_convert"):
    pytest.importorskip(package, reason="reports need the extra 'study'")


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    from sb3_belief.study.reporting import ReportOptions, write_report

    return write_report(ReportOptions(str(write_tuning(tmp_path_factory.mktemp("tunings") / "junction"))))[0]


@pytest.fixture
def driver(report):
    with browser() as driver:
        open_file(driver, report)
        yield driver
        assert complaints(driver) == []


def test_it_draws_sorts_and_hides(driver):
    for name in ("objective", "evaluations", "setting-learning_rate", "setting-belief"):
        driver.execute_script(f"document.getElementById('figure-{name}').scrollIntoView()")
        wait_for(lambda name=name: find(driver, f"[data-drawn='{name}'] svg"))
    (button,) = [each for each in find(driver, "#table-trials thead button") if each.text == "learning_rate"]
    button.click()
    rates = column(driver, 3, "trials")
    # As numbers: as texts 0.001 would stand before 0.0002
    assert len(rates) == 12 and rates == sorted(rates, key=float)
    marks = len(find(driver, "[data-drawn='objective'] svg path[fill='var(--arm-1)']"))
    assert marks == 7
    driver.execute_script("document.getElementById('progress').scrollIntoView()")
    find(driver, "#progress .legend button[data-arm='complete']")[0].click()
    wait_for(lambda: not find(driver, "[data-drawn='objective'] svg path[fill='var(--arm-1)']"))


def test_the_best_settings_are_copied(driver):
    driver.execute_script("navigator.clipboard.writeText = async (text) => { window.copied = text; }")
    (button,) = find(driver, "[data-copies='best-settings']")
    button.click()
    wait_for(lambda: button.text == "Copied")
    assert driver.execute_script("return window.copied").endswith("learning_rate: lin_0.001\n")
    find(driver, "[data-copies='quote']")[0].click()
    wait_for(lambda: driver.execute_script("return window.copied").startswith("We searched learning_rate"))


def test_a_phone_scrolls_in_one_direction_only(report):
    with browser(390, 844, phone=True) as phone:
        open_file(phone, report)
        assert phone.execute_script("return document.documentElement.scrollWidth - innerWidth") <= 0
        assert complaints(phone) == []
