"""Names of users: made safe for generated files that are code, made distinct, and compared with
known names."""

import difflib
import re
from collections.abc import Iterable
from itertools import chain, count

#: Line ends, control characters and characters that Slurm interprets within quotes: not allowed in
#: paths of scripts.
UNSAFE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\"\\]")


def in_comment(text: str) -> str:
    """A text in one line for comments and titles. Characters with a meaning in some language become
    underscores."""
    return re.sub(r"[^\w .,:;=()+/@-]", "_", text)


def as_word(text: str) -> str:
    """A text as one word in a file with columns."""
    return re.sub(r"[^A-Za-z0-9_.+*'-]", "_", text) or "_"


def as_identifier(text: str) -> str:
    """A text as a word of letters, digits and underscores."""
    return re.sub("[^A-Za-z0-9_]", "_", text) or "_"


def vector_text(values: Iterable[float]) -> str:
    """Numbers in parentheses."""
    return f"({', '.join(f'{x:g}' for x in values)})"


def distinct(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Names with numbers where they would be equal to others or taken: a, a_2."""
    names_in_use = list(taken)
    first = len(names_in_use)
    for name in names:
        numbered = (f"{name}_{k}" for k in count(2))
        names_in_use.append(next(one for one in chain([name], numbered) if one not in names_in_use))
    return names_in_use[first:]


#: With more similar names than this, no suggestion is made from a common starting or end.
MOST_SUGGESTIONS = 8
#: Limits of length and number of names beyond which none is suggested, because the comparison would
#: take long.
LONGEST_NAME, MOST_NAMES = 60, 1000


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' for an unknown name. Empty if no known name is similar."""
    return suggestion(similar_names(name, known))


def did_you_mean_first(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' with the first of the similar names, and all known names."""
    known = list(known)
    near = similar_names(name, known)[:1]
    return f"{suggestion(near)}{' There' if near else '; there'} are {', '.join(known)}"


def suggestion(names: list[str]) -> str:
    """'; did you mean ...?' for these names. Empty for none."""
    return f"; did you mean {' or '.join(names)}?" if names else ""


def similar_names(name: str, known: Iterable[str]) -> list[str]:
    """Known names that an unknown one may stand for: those that differ only in case and
    punctuation, else those that start with it, such as a key without its unit, or end with it, else
    the one with the most similar spelling."""
    known = list(known)
    if len(name) > LONGEST_NAME or len(known) > MOST_NAMES:
        return []
    plain = {key: plain_letters(key) for key in known}
    asked = plain_letters(name)
    near = [key for key, letters in plain.items() if letters == asked]
    if len(asked) > 1:
        near = near or [key for key, letters in plain.items() if letters.startswith(asked)]
        near = near or [key for key, letters in plain.items() if letters.endswith(asked)]
    if not near or len(near) > MOST_SUGGESTIONS:
        alike = difflib.get_close_matches(asked, plain.values(), 1, 0.6)
        near = [key for key, letters in plain.items() if letters in alike]
    return near


def plain_letters(name: str) -> str:
    """The letters and digits of a name in lower case, which are enough to recognise it."""
    return re.sub(r"[\W_]", "", name).lower()
