import json
import re

import pytest

from sb3_belief.report.page.markup import Html, json_script, markup_of, script_of, tag


def test_strings_are_escaped_and_markup_is_not():
    element = tag(
        "td", "<b>", tag("i", "&"), None, 3, class_='a"b', data_key=None, hidden=True, disabled=False, aria_label="x>y"
    )
    assert element == '<td class="a&quot;b" hidden aria-label="x&gt;y">&lt;b&gt;<i>&amp;</i>3</td>'
    assert tag("br") == "<br>" and markup_of("<", Html("<hr>")) == "&lt;<hr>"
    # An argument of the element's own may be called as the function's
    assert tag("meta", name="viewport") == '<meta name="viewport">'


def test_no_data_ends_its_script():
    data = {"</script><script>alert(1)</script>": ["<!--", "&amp;", "\u2028", "Ω"]}
    element = json_script("figures", data)
    found = re.fullmatch(r'<script type="application/json" id="figures">(.*)</script>', element, re.DOTALL)
    assert found is not None
    text = found[1]
    assert "<" not in text and ">" not in text and "&" not in text and "\u2028" not in text and "Ω" in text
    assert json.loads(text) == data
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_script("figures", float("nan"))


def test_no_script_of_ours_ends_its_element():
    assert script_of("a='</script>'; b='<!--'") == "<script>a='<\\/script>'; b='<\\!--'</script>"
