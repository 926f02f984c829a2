"""Which command lines only read: the only ones that may ever be asked twice."""

import re
from functools import lru_cache

_NUMBER = r"(?:\d+|\$[0-9A-F]+)"
_RANGE = rf"(?:\.\.{_NUMBER}|(?:,{_NUMBER}){{1,2}})?"
_LIST = (
    r"LIST(?:BUFFER|COMPDEF|COMP|BLCOMPDEF|BLCOMP|TCOMPDEF|TCOMP|GATHER|FORWARD|INVERSE|LDS|LINK"
    rf"|ROTARY|ROT|PC|PE|PLC{_NUMBER}|PROGRAM{_NUMBER}|PROG{_NUMBER})?(?:,{_NUMBER}?){{0,2}}"
)
_READS = "|".join(
    [
        r"VERSION|VER|TYPE|CID|CPU|DATE|TIME|TODAY|SIZE|SID|VID",
        _LIST,
        # M1-> asks for a definition only where no definition follows
        rf"M{_NUMBER}{_RANGE}->(?=$|[MIPQ#&])",
        rf"[IPQM]{_NUMBER}{_RANGE}(?![=\-\d])",
        rf"RH?[XYLD]?:?{_NUMBER}(?:,{_NUMBER})?",
        rf"(?:\#\#?|&){_NUMBER}?",
        r"\?{1,3}",
        r"%(?!\d)",
        r"[PVF](?![\d=$(])",
    ]
)
_LINE = re.compile(rf"(?:{_READS})+", re.IGNORECASE)
_BLANKS = re.compile(r"\s+")


@lru_cache(maxsize=4096)
def is_read(text: str) -> bool:
    """Whether a command line asks for values only and changes nothing but addressing.

    The test errs on the safe side: a line it does not know as a question counts as a command.

    Examples
    --------
    >>> is_read("#1P M162 I130"), is_read("M162=0"), is_read("M162->*"), is_read("J+")
    (True, False, False, False)
    """
    return _LINE.fullmatch(_BLANKS.sub("", text)) is not None
