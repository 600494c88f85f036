"""Hook of mkdocs with changes of the site's HTML that Markdown cannot express: `make docs`."""

import re

CODE = re.compile(r"(?<!<pre>)<code>([^<]*)</code>")
OPTION = re.compile(r"(?<![\w-])--?[a-z][\w-]*")
PICTURE = re.compile(r"(?<!\">)<img [^>]*src=\"([^\"]+)\"[^>]*>")

LONGEST_WORD = 24
"""Length from which on a name may be broken, after an underscore, a slash, a dot or a colon."""


def on_page_content(html: str, **_: object) -> str:
    """Keep options whole, let long names break between their words, and link pictures to their full size."""
    html = CODE.sub(lambda match: f"<code>{_broken(match[1])}</code>", html)
    return PICTURE.sub(r'<a href="\1">\g<0></a>', html)


def _broken(text: str) -> str:
    """Return code with the places where a line may end."""
    words = [
        re.sub(r"(?<=\w)(_|/|::|\.)(?=\w)", r"\1<wbr>", word) if len(word) > LONGEST_WORD else word
        for word in text.split(" ")
    ]
    return OPTION.sub(r'<span class="whole">\g<0></span>', " ".join(words))
