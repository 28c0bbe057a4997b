"""An HTML page as its tags and its text, for tests of what a page holds."""

from html.parser import HTMLParser


class HtmlPage(HTMLParser):
    """Tags with their attributes, and the text outside `style` and `script`."""

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
