"""The report page in a headless Chromium, used as a reader would."""

import shutil

import numpy as np
import pytest
import torch
from report_case import CLASSES, FRAMES, STRANGE, write_case, write_changes_case

from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.grid import BEVGrid
from gsmap.visualization.page.page import PageOptions, page_data, write_page
from gsmap.visualization.style import MATCH_COLOURS

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
from selenium.webdriver.chrome.service import Service  # noqa: E402
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(
    not (CHROMIUM and DRIVER), reason="no chromium and chromedriver (Debian: chromium-driver)"
)
ARGUMENTS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",  # containers have 64 MB of it
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--window-size=1400,900",
]
WAIT_S = 600  # as long as a test may take


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    data = page_data(*write_case(folder), PageOptions())
    write_page(folder / "report.html", data)
    write_page(folder / "truth.html", page_data(folder / "case.arrow", {}, PageOptions()))
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for argument in (*ARGUMENTS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


@pytest.fixture
def opened(browser, page):
    browser.get("about:blank")
    browser.get(page.as_uri())
    until_drawn(browser)
    yield browser
    assert browser.get_log("browser") == []  # no error, nothing refused by the page's policy


def text(browser, selector):
    return browser.find_element(By.CSS_SELECTOR, selector).text


def shown(browser, selector):
    return [e for e in browser.find_elements(By.CSS_SELECTOR, selector) if e.is_displayed()]


def press(browser, *keys):
    for key in keys:
        browser.switch_to.active_element.send_keys(key)


def choose(browser, name, value):
    browser.find_element(By.CSS_SELECTOR, f"#{name} option[value='{value}']").click()


def until_drawn(browser):
    """Scroll to the small maps and wait until they are drawn."""
    browser.execute_script("document.getElementById('grid').scrollIntoView()")
    drawn = (By.CSS_SELECTOR, ".card svg")
    WebDriverWait(browser, WAIT_S).until(lambda found: len(found.find_elements(*drawn)) == FRAMES)


def until_position(browser, position):
    """Wait for the frame at a position, counted from 1; 0 is the overview."""
    wanted = f"{position} of {FRAMES}" if position else ""
    WebDriverWait(browser, WAIT_S).until(lambda found: text(found, "#position") == wanted)


def open_frame(browser, index):
    browser.find_element(By.CSS_SELECTOR, f".card[href='#frame-{index}']").click()
    until_position(browser, index + 1)


def test_figures_and_strangers_texts_are_shown_as_text_and_nothing_is_fetched(opened):
    assert text(opened, "h1") == f"case val: good and {STRANGE}"
    assert len(shown(opened, "table")) == 1  # the means; the others are folded away
    opened.find_element(By.CSS_SELECTOR, "#figures summary").click()
    assert len(shown(opened, "table")) == 5  # and where two results differ
    assert len(shown(opened, "#curves figure")) == 8  # two of Gaussians
    assert len(shown(opened, ".card svg")) == FRAMES
    assert opened.find_elements(By.CSS_SELECTOR, "main img") == []
    fetched = opened.execute_script(
        "return performance.getEntriesByType('resource').map((entry) => entry.name)"
    )
    assert [name for name in fetched if not name.startswith("data:")] == []


def test_the_slider_recolours_by_threshold_from_the_keyboard(opened):
    assert text(opened, "#totals").startswith("good: 9 hits, 3 false, 9 missed, F1 60 %; ")
    card = ".card[href='#frame-0'] "
    assert len(shown(opened, card + ".found")) == 2
    hit = opened.find_element(By.CSS_SELECTOR, card + ".hit")
    red, green, blue = (int(MATCH_COLOURS["hit"][i : i + 2], 16) for i in (1, 3, 5))
    assert hit.value_of_css_property("stroke") == f"rgb({red}, {green}, {blue})"
    opened.execute_script("document.getElementById('score').focus()")
    press(opened, *[Keys.ARROW_RIGHT] * 11)
    assert text(opened, "#score-value") == "0.51"
    assert text(opened, "#totals").startswith("good: 3 hits, 3 false, 15 missed, F1 25 %; ")
    assert len(shown(opened, card + ".found")) == 1
    press(opened, Keys.HOME)
    assert text(opened, "#totals").startswith("good: 9 hits, 9 false, 9 missed, F1 50 %; ")
    choose(opened, "colour", "class")
    assert hit.value_of_css_property("stroke") == "rgb(29, 185, 84)"  # a boundary


def test_frames_are_sorted_by_worst_and_best(opened):
    def order():
        cards = opened.find_elements(By.CSS_SELECTOR, ".card")
        return [int(card.get_attribute("href").rsplit("-", 1)[1]) for card in cards]

    assert order() == [0, 1, 2, 3, 4, 5]
    choose(opened, "order", "worst")
    assert order() == [3, 4, 5, 0, 1, 2]
    choose(opened, "order", "gain")  # the first result's F1 less the second's
    assert order() == [3, 4, 5, 0, 1, 2]
    choose(opened, "order", "best")
    assert order() == [0, 1, 2, 3, 4, 5]


def test_a_frame_opens_and_closes_from_the_keyboard(opened):
    opened.execute_script("document.querySelector('.card').focus()")
    press(opened, Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    focused = opened.switch_to.active_element
    assert focused.get_attribute("href").endswith("#frame-2")
    assert focused.value_of_css_property("outline-style") == "solid"
    press(opened, Keys.ENTER)
    until_position(opened, 3)
    assert text(opened, "#frame-title") == f"{STRANGE}, 2.0 s"
    assert not shown(opened, "#grid, #figures")
    for key, position in ((Keys.ARROW_RIGHT, 4), (Keys.ARROW_LEFT, 3), (Keys.ARROW_LEFT, 2)):
        press(opened, key)
        until_position(opened, position)
    press(opened, Keys.ESCAPE)
    until_position(opened, 0)
    assert opened.switch_to.active_element.get_attribute("href").endswith("#frame-1")
    assert shown(opened, "#grid")


def test_a_frame_has_cameras_both_results_and_layers(opened):
    open_frame(opened, 1)
    assert [e.text for e in shown(opened, "#cameras figcaption")] == ["front", "back"]
    assert [e.text for e in shown(opened, "#maps strong")] == ["good", STRANGE]
    captions = [e.text for e in shown(opened, "#maps figcaption span")]
    assert captions == [
        "2 hits, 0 false, 1 missed, F1 80 %",
        "1 hits, 0 false, 2 missed, F1 50 %",
    ]
    maps = opened.find_elements(By.CSS_SELECTOR, "#maps svg")
    counts = {"truth": 6, "found": 3, "gauss": 0, "score": 0}
    for layer, number in counts.items():
        assert len(shown(opened, f"#maps .{layer}:not(.tick)")) == number, layer
        opened.find_element(By.CSS_SELECTOR, f"[data-layer={layer}]").click()
    assert not shown(opened, "#maps .truth, #maps .found, #cameras .line")
    assert len(shown(opened, "#maps .gauss")) == 2
    assert [e.text for e in shown(opened, "#maps .score")] == ["0.90", "0.50", "0.50"]
    opened.find_element(By.CSS_SELECTOR, "[data-layer=mask]").click()
    assert len(maps[0].find_elements(By.CSS_SELECTOR, ".mask[href^='data:image/png']")) == 1
    assert not maps[1].find_elements(By.CSS_SELECTOR, ".mask")


def test_a_camera_shows_what_lies_before_it(opened):
    """The ground lies 1.5 m under the camera: at 20 m it is 80 * 1.5 / 20 px below the middle."""
    open_frame(opened, 0)
    front, back = opened.find_elements(By.CSS_SELECTOR, "#cameras svg")
    path = front.find_element(By.CSS_SELECTOR, ".truth").get_attribute("d")
    near, far = ([float(v) for v in point.split()] for point in path[1:].split("L"))
    assert near == pytest.approx([80, 45 + 80 * 1.5 / 0.3], abs=0.1)
    assert far == pytest.approx([80, 45 + 80 * 1.5 / 20], abs=0.1)
    assert len(front.find_elements(By.CSS_SELECTOR, ".truth")) == 3
    assert len(back.find_elements(By.CSS_SELECTOR, ".truth")) == 2  # the crossing lies ahead


def test_masks_are_those_of_the_renderer(opened):
    item = {"p": [0, 0, 300, 400], "g": [200, 50, 30, 100, 100, 0]}
    extent = [-8, 8, -4, 8]
    found = opened.execute_script("return [...occupancy(...arguments)]", item, extent, 64, 48)
    grid = BEVGrid((-8.0, 8.0), (-4.0, 8.0), 48, 64)
    expected = render_gaussians(
        torch.tensor([[0.0, 0], [3, 4]]),
        torch.tensor([[2.0, 0.5], [1, 1]]),
        torch.tensor([np.pi / 6, 0.0]),
        grid,
        backend="reference",
    )
    # the page cuts a Gaussian at four sigma of its longer axis: exp(-8)
    np.testing.assert_allclose(np.reshape(found, (48, 64))[::-1], expected, atol=5e-4)


@pytest.mark.parametrize("frame", [None, 0])
def test_a_phone_shows_everything_in_its_width(opened, frame):
    size = {"width": 360, "height": 740, "deviceScaleFactor": 1, "mobile": True}
    opened.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    if frame is not None:
        open_frame(opened, frame)
    width = opened.execute_script("return document.documentElement.scrollWidth")
    opened.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert width == 360


def test_long_names_stay_within_their_places(browser, page):
    """Names of results, of 70 letters without a space, on a desk and on a phone."""
    results = {f"{name}_{'long' * 16}": page.with_name(f"{name}.json") for name in ("good", "poor")}
    data = page_data(page.with_name("case.arrow"), results, PageOptions(image_width=0))
    write_page(page.with_name("long.html"), data)
    browser.get(page.with_name("long.html").as_uri())
    browser.find_element(By.CSS_SELECTOR, "#figures summary").click()
    overflowing = """
        const places = [...document.querySelectorAll('th, td, h1, h2, .pick, #zoom, #maps figure')];
        const wide = places.filter((place) => place.scrollWidth > place.clientWidth + 1);
        return wide.map((place) => place.textContent);
    """
    for width in (1400, 360):
        size = {"width": width, "height": 740, "deviceScaleFactor": 1, "mobile": width < 500}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        assert browser.execute_script(overflowing) == []
    open_frame(browser, 0)
    browser.find_element(By.CSS_SELECTOR, "#maps svg").click()
    assert shown(browser, "#zoom")
    assert browser.execute_script(overflowing) == []
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert browser.get_log("browser") == []


def test_small_maps_are_drawn_when_they_come_near(browser, page):
    data = page_data(page.with_name("case.arrow"), {}, PageOptions(image_width=0))
    write_page(page.with_name("many.html"), data | {"frames": 60 * data["frames"]})
    browser.get(page.with_name("many.html").as_uri())
    drawn = "return document.querySelectorAll('.card svg').length"
    WebDriverWait(browser, WAIT_S).until(lambda found: found.execute_script(drawn))
    assert browser.execute_script(drawn) < 30 * FRAMES
    browser.execute_script("document.querySelector('.card:last-child').scrollIntoView()")
    last = (By.CSS_SELECTOR, ".card:last-child svg")
    WebDriverWait(browser, WAIT_S).until(lambda found: found.find_elements(*last))


def test_the_first_screen_has_the_best_typical_and_worst_frame(opened):
    """Frames 0 to 2 find the divider: F1 4 of 5; the others 2 of 6 (below 1 false, 2 missed)."""
    picks = opened.find_elements(By.CSS_SELECTOR, ".pick")
    said = [
        (e.find_element(By.TAG_NAME, "strong").text, e.get_attribute("href")[-1]) for e in picks
    ]
    assert said == [("Best", "0"), ("Typical", "3"), ("Worst", "5")]
    assert [e.text for e in shown(opened, ".pick .figure")] == ["F1 80 %", "F1 40 %", "F1 40 %"]
    assert len(shown(opened, ".pick .bev")) == len(shown(opened, ".pick .camera")) == 3
    opened.execute_script("scrollTo(0, 0)")
    assert max(e.rect["y"] + e.rect["height"] for e in picks) < 600  # no scrolling
    picks[2].click()
    until_position(opened, 6)


def test_filters_of_class_scene_and_token(opened):
    choose(opened, "class", "0")  # dividers: 3 hits of 6 frames, none false above 0.4
    assert text(opened, "#totals").startswith("good: 3 hits, 3 false, 3 missed, F1 50 %; ")
    assert len(shown(opened, ".card[href='#frame-0'] .line")) == 2
    choose(opened, "class", "-1")
    opened.find_element(By.ID, "token").send_keys("T4")
    assert [e.get_attribute("href")[-1] for e in shown(opened, ".card")] == ["4"]
    assert "(1 of the 6 frames on this page" in text(opened, "#totals")
    assert len(shown(opened, ".pick")) == 1
    opened.find_element(By.ID, "token").send_keys("x")
    assert not shown(opened, ".card, .pick")
    assert text(opened, "#totals") == "The filters leave no frame: there is nothing to score."
    scenes = [
        e.get_attribute("value") for e in opened.find_elements(By.CSS_SELECTOR, "#scene option")
    ]
    assert scenes == ["", STRANGE]


def test_a_picture_is_enlarged_by_a_click_and_zoomed(opened):
    open_frame(opened, 1)
    opened.find_element(By.CSS_SELECTOR, "#maps svg").click()
    assert text(opened, "#zoom-title") == "good, bird's-eye view"
    large = opened.find_element(By.CSS_SELECTOR, "#zoomed svg")
    whole = large.get_dom_attribute("viewBox")
    for button, factor in (("closer", 0.7), ("farther", 1.0)):
        opened.find_element(By.ID, button).click()
        box = [float(v) for v in large.get_dom_attribute("viewBox").split()]
        assert box[2:] == pytest.approx([30 * factor, 60 * factor])
    wheel = "arguments[0].dispatchEvent(new WheelEvent('wheel', {deltaY: -1, bubbles: true}))"
    opened.execute_script(wheel, large)
    assert float(large.get_dom_attribute("viewBox").split()[2]) == pytest.approx(30 * 0.85)
    opened.find_element(By.ID, "whole").click()
    assert large.get_dom_attribute("viewBox") == whole
    press(opened, Keys.ESCAPE)
    assert not shown(opened, "#zoom")
    assert text(opened, "#position") == f"2 of {FRAMES}"  # the frame is still open
    opened.find_element(By.CSS_SELECTOR, "#cameras svg").click()
    assert text(opened, "#zoom-title") == "camera front"


def test_dark_mode_has_a_dark_page_and_light_text(opened):
    def colours():
        body = opened.find_element(By.TAG_NAME, "body")
        values = (body.value_of_css_property(name) for name in ("background-color", "color"))
        return [int(value.split("(")[1].split(",")[0]) for value in values]

    for scheme, dark in (("dark", True), ("light", False)):
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        opened.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        background, ink = colours()
        assert (background < 60 and ink > 200) if dark else (background > 200 and ink < 60)


def test_ground_truth_alone_has_no_controls_of_predictions(browser, page):
    browser.get(page.with_name("truth.html").as_uri())
    assert not shown(browser, "#figures, #picks, #score, #order, #totals")
    assert [e.text for e in shown(browser, "#legend li")] == [
        "divider",
        "pedestrian crossing",
        "road boundary",
    ]
    assert len(CLASSES) == 3
    open_frame(browser, 0)
    assert [e.text for e in shown(browser, "#maps strong")] == ["Ground truth"]
    assert len(shown(browser, "#maps .truth")) == 3
    assert browser.get_log("browser") == []


def test_changes_are_a_layer_with_words(browser, page, tmp_path):
    changes = write_changes_case(tmp_path / "changes.geojson")
    results = {"good": page.with_name("good.json")}
    options = PageOptions(image_width=0, changes=changes)
    write_page(tmp_path / "p.html", page_data(page.with_name("case.arrow"), results, options))
    browser.get((tmp_path / "p.html").as_uri())
    until_drawn(browser)
    open_frame(browser, 1)
    drawn = shown(browser, "#maps .bev .change")
    assert [line.get_attribute("class") for line in drawn] == ["change moved", "change removed"]
    title = drawn[0].find_element(By.TAG_NAME, "title").get_attribute("textContent")
    assert title == "divider moved by 1.02 \N{PLUS-MINUS SIGN} 0.05 m"
    legend = text(browser, "#legend")
    assert "removed" in legend
    assert "added" not in legend  # none in these frames
    shown(browser, "[data-layer=change]")[0].click()
    assert not shown(browser, "#maps .bev .change")
    assert "Changes of the map" in browser.page_source
    assert browser.get_log("browser") == []
