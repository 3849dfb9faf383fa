"""Taking control on a page, as a person does."""

from __future__ import annotations

from tests.live.console.browser import Browser


def take_control(browser: Browser) -> None:
    """Press *Take control*, and wait until the page has it."""
    browser.until("document.body.dataset.control === 'nobody'")
    browser.click("lease-button")
    browser.until("document.body.dataset.control === 'mine'")
