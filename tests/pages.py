"""Tags and text of an HTML page."""

from html.parser import HTMLParser


class HtmlPage(HTMLParser):
    """The tags of a page with their attributes, and its text outside `style` and `script`."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.text, self._inside = [], "", ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        self._inside = tag

    def handle_data(self, data):
        if self._inside not in ("style", "script"):
            self.text += data

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]
