"""HTML whose strings are escaped unless they are markup already."""

import html
import json
from typing import Any

# Elements without an end tag
_VOID = {"meta", "link", "input", "br", "hr", "img"}


class Html(str):
    """Markup: text that is put on a page as it is. Any other string is escaped."""


def tag(name: str, /, *children: object, **attributes: object) -> Html:
    """
    Return an element.

    :param name: Name of the element
    :param children: What it holds: ``Html``, or anything else, whose text is escaped. None is left out
    :param attributes: Attributes, with ``_`` for ``-``; one at the end is cut (``class_``). None and False leave an attribute
        out, and True gives it without a value
    :return: The element
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        attribute = key.rstrip("_").replace("_", "-")
        words.append(attribute if value is True else f'{attribute}="{html.escape(str(value), quote=True)}"')
    opening = " ".join(words)
    return Html(f"<{opening}>" if name in _VOID else f"<{opening}>{markup_of(*children)}</{name}>")


def markup_of(*children: object) -> Html:
    """
    Return several pieces of a page as one.

    :param children: ``Html``, or anything else, whose text is escaped. None is left out
    :return: Their markup, one after the other
    """
    return Html("".join(child if isinstance(child, Html) else _escaped(child) for child in children if child is not None))


def copy_button(of: str, words: str) -> Html:
    """
    Return a button that copies the text of an element.

    :param of: Id of the element
    :param words: What the button says
    :return: The button
    """
    return tag("button", words, type="button", class_="plain", data_copies=of)


def json_script(identifier: str, value: Any) -> Html:
    """
    Return an element that holds data for the page's script.

    No text in the data can end the element: ``<``, ``>`` and ``&`` are written as JSON's escapes.

    :param identifier: Id of the element
    :param value: What ``json`` can write
    :return: The element
    :raises ValueError: If there is a number that is not finite, which JSON has no words for
    """
    text = json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return tag("script", Html(text), type="application/json", id=identifier)


def script_of(source: str) -> Html:
    """
    Return a script of ours as an element.

    :param source: JavaScript. What would end the element, which only a string or a comment of it can hold, is escaped
    :return: The element
    """
    return tag("script", Html(source.replace("</script", "<\\/script").replace("<!--", "<\\!--")))


def _escaped(text: object) -> str:
    return html.escape(str(text), quote=False)
