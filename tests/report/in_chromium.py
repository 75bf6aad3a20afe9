"""What tests of pages in Chromium share: where it is, and what they ask of a page."""

from __future__ import annotations

import shutil

PROGRAMS = ("chromium-headless-shell", "chromium", "google-chrome")
PROGRAM = next((path for path in map(shutil.which, PROGRAMS) if path), None)

CUT_OFF = """() => [...document.querySelectorAll("body *")]
  .filter(e => !e.closest("svg") && !e.closest("thead") && !e.closest("caption"))
  .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5 || e.scrollWidth > e.clientWidth + 1 && e.clientWidth)
  .map(e => e.tagName + " " + e.textContent.slice(0, 60))"""
LETTERS_PX = """() => [...document.querySelectorAll("svg text")].filter(e => e.getClientRects().length)
  .map(e => parseFloat(getComputedStyle(e).fontSize) * Math.hypot(e.getCTM().a, e.getCTM().b))"""
OUTSIDE = """() => [...document.querySelectorAll("svg text")].filter(e => e.getClientRects().length).filter(e => {
  const a = e.getBoundingClientRect(), b = e.closest("svg").getBoundingClientRect();
  return a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1 || a.bottom > b.bottom + 1;
}).map(e => e.textContent)"""
