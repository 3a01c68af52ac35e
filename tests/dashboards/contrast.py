"""Contrast of a page's texts by WCAG 2."""

from __future__ import annotations

import re
from typing import Any

TEXTS = """
const found = [];
const ground = node => {
  for (let at = node; at; at = at.parentElement) {
    const colour = getComputedStyle(at).backgroundColor;
    if (!/, 0\\)$/.test(colour)) return colour;
  }
  return 'rgb(255, 255, 255)';
};
for (const node of document.querySelectorAll('body *')) {
  const own = [...node.childNodes].some(child => child.nodeType === 3 && child.textContent.trim());
  if (!own || !node.checkVisibility() || node.closest('script, style, .annotation, noscript')) continue;
  if (node.disabled || node.closest('option')) continue;  // WCAG asks nothing of what is disabled
  const style = getComputedStyle(node), inPlot = node instanceof SVGElement;
  found.push([inPlot ? style.fill : style.color, ground(node), node.textContent.trim().slice(0, 40)]);
}
return found;
"""
"""Colour, background and words of every visible text, except numbers on heat maps."""


def luminance(colour: str) -> float:
    """Relative luminance of `rgb(…)`."""
    parts = [int(float(number)) / 255 for number in re.findall(r"[\d.]+", colour)[:3]]
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast_of(one: str, other: str) -> float:
    """Contrast ratio of two colours, 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def poor_texts(page: Any) -> list[tuple[str, float]]:
    """Texts whose contrast is below 4.5."""
    seen = page.execute_script(TEXTS)
    assert len(seen) > 100
    ratios = [(words, round(contrast_of(colour, ground), 2)) for colour, ground, words in seen]
    return [(words, ratio) for words, ratio in ratios if ratio < 4.5]
