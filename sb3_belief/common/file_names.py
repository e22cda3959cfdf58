"""Names of files for agents, whose own names may be any text."""

import hashlib
import re
from urllib.parse import quote

# What every usual file system takes as it is, letters of all languages included; no dot at an end, where it means something
_PLAIN = re.compile(r"[\w ()+,=@\[\]{}~-]([\w .()+,=@\[\]{}~-]*[\w()+,=@\[\]{}~-])?")
# Most file systems take 255 bytes, and endings are added
_LONGEST = 150


def file_name(name: str) -> str:
    """
    Return the name of a file or folder for an agent, without its ending.

    Most names are returned as they are. Others are quoted as in URLs, so that no name leads out of a folder, and shortened if
    they are too long. Different names have different files.

    :param name: Name of the agent
    :return: Something that can be one part of a path
    """
    if _PLAIN.fullmatch(name) and len(name.encode()) <= _LONGEST:
        return name
    # quote() leaves dots as they are. A single percent sign is never what it returns
    quoted = quote(name, safe="()+,=@[]{}", errors="surrogatepass").replace(".", "%2E") or "%"
    if len(quoted) <= _LONGEST:
        return quoted
    digest = hashlib.sha256(name.encode(errors="surrogatepass")).hexdigest()[:16]
    return f"{quoted[:100]}%{digest}"
