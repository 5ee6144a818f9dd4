"""Read a report page strictly: its elements are known, and no content is loaded or inserted by a user."""

import base64
import hashlib
import io
import json
import re
from html.parser import HTMLParser

import matplotlib.image

from tuning.output import page

ELEMENTS = {
    "html", "head", "meta", "title", "link", "style", "body", "header", "p", "h1", "h2", "main", "section", "div",
    "table", "thead", "tbody", "tr", "th", "td", "span", "svg", "rect", "line", "figure", "figcaption", "img", "pre",
    "script",
}  # fmt: skip
VOID = {"meta", "link", "img"}


class Page(HTMLParser):
    """Parser of an HTML text that fails at unknown elements, event handlers and links to other files.

    `found` is a list of (element, attributes), `images` are the sources of images, and `scripts` the texts of scripts.
    """

    def __init__(self, text):
        super().__init__()
        self.found, self.texts, self.scripts, self.open, self.images = [], [], [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        """Check an element and its attributes, and record them."""
        assert tag in ELEMENTS, tag
        for name, value in attrs:
            assert not name.startswith("on"), (tag, name)
            assert name not in ("src", "href") or (value or "").startswith("data:"), (tag, name)
        self.found.append((tag, dict(attrs)))
        if tag == "img":
            self.images.append(dict(attrs)["src"])
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        """Check and record an element that ends at once."""
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        """Check that the innermost open element ends."""
        assert self.open.pop() == tag

    def handle_data(self, data):
        """Record text, separately inside and outside of scripts."""
        (self.scripts if self.open and self.open[-1] == "script" else self.texts).append(data)

    @property
    def text(self):
        """The text that a reader of the page sees, with single spaces."""
        return " ".join(" ".join(self.texts).split())

    @property
    def charts(self):
        """Data of the charts by the name of their places, a dict."""
        return json.loads(self.scripts[0]) if self.scripts else {}


def checked(folder):
    """Build the page of a result folder, check everything that holds for every page, and return it as a `Page`."""
    made = page.build(folder)
    read = Page(made)
    (policy,) = [attrs["content"] for tag, attrs in read.found if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src ")
    checksums = [base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in read.scripts[1:]]
    assert re.findall(r"'sha256-([^']+)'", policy) == checksums
    places = {attrs["id"] for tag, attrs in read.found if tag == "div" and attrs.get("class", "").startswith("chart")}
    assert set(read.charts) == places
    assert len(read.scripts) == (3 if places else 0)
    pictures = sorted((folder / "figures").glob("*.png"))
    assert len(read.images) == len(pictures)
    if read_versions(folder)["command"] != "reproduce":
        assert all(page.CAPTIONS[path.stem] in read.text for path in pictures)
    for source, path in zip(read.images, pictures, strict=True):
        content = base64.b64decode(source.removeprefix("data:image/png;base64,"))
        assert content == path.read_bytes()
        assert matplotlib.image.imread(io.BytesIO(content)).std() > 0.0
    for said in (f"ptsmc {read_versions(folder)['command']}", "How to make this again", "Made by"):
        assert said in read.text
    return read


def read_versions(folder):
    """Return the content of versions.json, the record of the command of a result folder, as a dict."""
    return json.loads((folder / "versions.json").read_text())
