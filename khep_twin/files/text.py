"""Users' text files, in UTF-8."""

import codecs

_EXPECTED = "expected UTF-8, as which an editor can save it"


def check_encoding(head: bytes) -> None:
    """Check the first bytes of a text.

    Raises:
        ValueError: It is in UTF-16, as some editors and spreadsheets write it.
    """
    # UTF-16 without a byte order mark has a zero byte in its first character.
    if head[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE) or b"\0" in head[:2]:
        raise ValueError(f"this is text in UTF-16; {_EXPECTED}")


def decode(data: bytes) -> str:
    """Return a text, without a byte order mark.

    Raises:
        ValueError: It is in another encoding, or no text.
    """
    check_encoding(data)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start} is no UTF-8 text; {_EXPECTED}") from None


def escape_surrogates(text: str) -> str:
    """Return a text whose surrogates, which UTF-8 cannot encode, are replaced by escape sequences."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
