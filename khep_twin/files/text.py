"""Text files of users, which are in UTF-8."""

import codecs

_WISH = "expected UTF-8, as which an editor can save it"


def check_encoding(begin: bytes) -> None:
    """Check the first bytes of a text.

    Raises:
        ValueError: It is in UTF-16, as some editors and spreadsheets write it.
    """
    # Without a mark, the zero byte of the first character shows it.
    if begin[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) or b"\0" in begin[:2]:
        raise ValueError(f"this is text in UTF-16; {_WISH}")


def decode(data: bytes) -> str:
    """Return a text, without a byte order mark.

    Raises:
        ValueError: It is in another encoding, or no text.
    """
    check_encoding(data)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start} is no UTF-8 text; {_WISH}") from None


def encodable(text: str) -> str:
    """Return a text whose characters that no file can hold, such as those of other bytes, are codes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
