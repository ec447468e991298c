"""Reports in a real browser: no errors, no requests, a surface that can be seen and turned, a slider, phones, the dark.

Skipped where Chromium is not installed, and not even there with ``LEAFFLOW_TI_REQUIRE_CHROMIUM=1``, as the continuous
integration sets.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Page, chromium, pixels_of
from report_stores import make_store

from leafflow_ti.report import write_report

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

READY = "document.getElementById('ruler')?.style.width && document.querySelector('#scale .bar')"
CANVAS = "document.getElementById('surface')"


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with chromium() as page:
        yield page


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    return write_report(make_store(folder / "leaf.zarr"), folder / "page.html")


@pytest.fixture
def page(browser: Page, report: Path) -> Iterator[Page]:
    """The report, opened; whatever a test does to it, it complains about nothing and asks for nothing."""
    browser.open(report)
    browser.until(READY)
    yield browser
    assert browser.complaints == []
    assert browser.requests == [report.resolve().as_uri()]


def seen(page: Page) -> np.ndarray:
    """The canvas [y, x, (red, green, blue)] after the next frame was drawn, on its own."""
    uri = page.ask(
        f"new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done({CANVAS}.toDataURL()))))"
    )
    return pixels_of(base64.b64decode(uri.partition(",")[2]))


def settled(page: Page, before: np.ndarray) -> np.ndarray:
    """The canvas once it differs from ``before``."""
    for _ in range(100):
        now = seen(page)
        if now.shape != before.shape or (now != before).any():
            return now
    pytest.fail("the canvas does not change")


def middle(page: Page) -> tuple[float, float]:
    page.ask(f"{CANVAS}.scrollIntoView({{block: 'center'}})")
    found = page.ask(
        f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({CANVAS}.getBoundingClientRect())"
    )
    return float(found[0]), float(found[1])


def choose(page: Page, key: str, value: object, event: str) -> None:
    """Set a control as its user would."""
    page.ask(f"(() => {{ const c = document.getElementById('{key}'); c.value = '{value}'; "
             f"c.dispatchEvent(new Event('{event}', {{bubbles: true}})); }})()")  # fmt: skip


def test_surface_is_seen_in_the_map_s_colours(page: Page) -> None:
    with_arrows = seen(page)
    page.ask("document.getElementById('arrows').click()")
    image = settled(page, with_arrows).astype(int)
    painted = image.sum(axis=-1) > 0
    assert 0.05 < painted.mean() < 0.9
    reddish = image[..., 0] > image[..., 2] + 20  # growth is positive all over
    assert reddish[painted].mean() > 0.95
    assert len(np.unique(image[painted], axis=0)) > 50  # shaded


def test_drag_keys_and_wheel_turn_and_zoom(page: Page) -> None:
    x, y = middle(page)
    first = seen(page)
    page.drag(x, y, 120, 30)
    turned = settled(page, first)
    page.ask(f"{CANVAS}.focus()")
    page.press("+")
    larger = settled(page, turned)
    assert (larger > 0).any(axis=-1).mean() > (turned > 0).any(axis=-1).mean()
    page.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=400)
    smaller = settled(page, larger)
    assert (smaller > 0).any(axis=-1).mean() < (larger > 0).any(axis=-1).mean()
    page.press("0")
    settled(page, smaller)
    assert (seen(page) == first).all()


def test_wheel_scrolls_the_page_until_the_surface_was_chosen(page: Page) -> None:
    x, y = middle(page)
    before = page.ask("window.scrollY")
    page.call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=200)
    page.until(f"window.scrollY > {before}")


def test_slider_changes_maps_curves_and_surface(page: Page) -> None:
    source = "document.querySelector('figure[data-panel=growth_rate] img').src"
    state = (
        f"[{source}, document.querySelector('.now').getAttribute('x1'), document.getElementById('frame-label').value]"
    )
    before, surface = page.ask(state), seen(page)
    choose(page, "frame", 2, "input")
    after = page.ask(state)
    assert all(a != b for a, b in zip(before, after, strict=True))
    assert after[2] == "frame 4 · 4 min"
    settled(page, surface)
    choose(page, "frame", 1, "input")
    assert page.ask(state) == before


def test_play_runs_through_the_frames(page: Page) -> None:
    label = "document.getElementById('frame-label').value"
    before = page.ask(label)
    page.ask("document.getElementById('play').click()")
    page.until(f"{label} !== '{before}'")
    page.ask("document.getElementById('play').click()")
    assert page.ask("document.getElementById('play').textContent") == "Play"


def test_another_map_and_longer_arrows_change_the_surface(page: Page) -> None:
    first = seen(page)
    choose(page, "stretch", 2, "input")
    longer = settled(page, first)
    page.ask("document.getElementById('arrows').click()")
    bare = settled(page, longer)
    choose(page, "colour", "depth", "change")
    settled(page, bare)
    assert "mm" in page.ask("document.getElementById('scale').textContent")


def test_phone_width_has_no_overflow(browser: Page, report: Path) -> None:
    browser.open(report, 360, 740, touch=True)
    browser.until(READY)
    assert browser.ask("document.documentElement.scrollWidth") == 360
    wide = "[...document.querySelectorAll('main *')].filter((e) => !e.closest('svg, .scroll, .stage') && "
    assert browser.ask(f"{wide}e.getBoundingClientRect().right > 361).map((e) => e.outerHTML.slice(0, 80))") == []
    assert (seen(browser) > 0).any()
    assert browser.complaints == []


def test_dark_scheme_is_dark(browser: Page, report: Path) -> None:
    shades = []
    for dark in (False, True):
        browser.open(report, dark=dark)
        browser.until(READY)
        corner = pixels_of(browser.picture())[:20, :20]
        shades.append(float(corner.mean()))
        body = "getComputedStyle(document.body)"
        text, ground = (luminance(browser.ask(f"{body}.{name}")) for name in ("color", "backgroundColor"))
        assert (max(text, ground) + 0.05) / (min(text, ground) + 0.05) > 7  # contrast as WCAG's level AAA asks
    assert shades[0] > 240
    assert shades[1] < 40


def luminance(colour: str) -> float:
    """Relative luminance of ``rgb(r, g, b)`` in sRGB."""
    values = np.array([float(v) for v in colour.removeprefix("rgb(").rstrip(")").split(",")]) / 255
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_page_without_webgl_says_so(browser: Page, report: Path, tmp_path: Path) -> None:
    """The same page, with a browser that has no WebGL: the rest works."""
    hidden = "HTMLCanvasElement.prototype.getContext = () => null;"
    added = browser.call("Page.addScriptToEvaluateOnNewDocument", source=hidden)
    try:
        browser.open(report)
        browser.until("document.getElementById('frame-label').value")
        assert browser.ask("document.getElementById('no-webgl').offsetHeight") > 0
        assert browser.ask(CANVAS) is None
        assert browser.ask("document.querySelector('#view .tools').offsetHeight") == 0
    finally:
        browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert browser.complaints == []


def test_scripts_from_outside_do_not_run(browser: Page, tmp_path: Path) -> None:
    evil = "</script><script>window.caught = 1</script><img src=x onerror='window.caught = 1'>"
    store = make_store(tmp_path / "leaf.zarr", device=evil, config=evil)
    browser.open(write_report(store, tmp_path / "page.html", title=evil))
    browser.until(READY)
    assert browser.ask("window.caught") is None
    assert browser.ask("document.querySelector('h1').textContent") == evil
    assert browser.complaints == []


def test_flow_alone_opens_without_errors(browser: Page, tmp_path: Path) -> None:
    store = make_store(tmp_path / "flow.zarr", frames=(4,), names=("flow_x", "flow_y"))
    browser.open(write_report(store, tmp_path / "page.html"))
    assert browser.ask("document.querySelectorAll('.plate path').length") == 2
    assert browser.complaints == []
