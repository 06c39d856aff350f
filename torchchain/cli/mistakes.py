"""The parser's report of a mistake as one line: flag, rule, value, and what was meant."""

from __future__ import annotations

import re

from torchchain.cli.choices import OBSERVABLES
from torchchain.cli.flags import COMMANDS, names
from torchchain.spelling import meant, suggestion

CLUMSY = {
    r"^Unrecognized options Unrecognized or misplaced options: (.*?) Arguments are applied.*": r"Unrecognized options: \1",
    r" \(applied to torchchain \w+\)(?= )": ",",
    r" \(applied to torchchain \w+\)$": "",
    r"^Unrecognized options: ([^\s,]+).* Available subcommands: (.*)": r"\1 is none of the commands \2",
    r"^Required options Missing from torchchain (\w+): (.*?) \(required\)": r"torchchain \1 needs \2",
}
"""The parser's words, and the same as one phrase."""


def one_line(report: str, arguments: list[str]) -> str:
    """The boxed report on these arguments in one line."""
    lines = [line.strip("│╭╮╰╯─ ").strip() for line in report.splitlines()]
    text = " ".join(line for line in lines if line.strip("-"))
    text = re.sub(r"\s*(For full helptext|Argument helptext|Got errors|Perhaps you meant|Similar).*", "", text)
    text = re.sub(r"^(Unrecognized options?|Missing \w+) (?=\1)", "", text)
    for clumsy, plain in CLUMSY.items():
        text = re.sub(clumsy, plain, text)
    value = re.search(r"Error parsing (\S+): .*?no type matching (.*?) could be instantiated from \[(.*?)\]", text)
    if value:
        kind = value[2].replace("{None}|", "").strip("{}")
        return f"{value[1]} must be {kind}, got {value[3]}"
    unknown = re.search(r"Unrecognized options?: (\S+?),?(?: |$)", text)
    command = next((word for word in arguments if not word.startswith("-")), None)
    if unknown and command in COMMANDS:
        flags = names(COMMANDS[command])
        measured = meant(unknown[1], OBSERVABLES) if "--observables" in flags else None
        text += suggestion(unknown[1], flags) or (f"; did you mean --observables {measured}?" if measured else "")
    elif command is not None and command not in COMMANDS:
        text += suggestion(command, COMMANDS)
    return text
