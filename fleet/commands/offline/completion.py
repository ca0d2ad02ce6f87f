"""Print the completion of `fleet` for a shell: verbs, their options and files."""

import argparse

from fleet.cli import Parser, command_modules, fleet_parser

EXAMPLES = """
  fleet completion bash > ~/.local/share/bash-completion/completions/fleet
  fleet completion zsh > ~/.zfunc/_fleet                 a folder of $fpath
  fleet completion fish > ~/.config/fish/completions/fleet.fish
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the argument."""
    parser.add_argument("shell", choices=tuple(SCRIPTS), help="shell to complete in")


def run(args: argparse.Namespace) -> int:
    """Print the script; return exit code 0."""
    print(SCRIPTS[args.shell](verb_parsers()), end="")
    return 0


def verb_parsers() -> dict[str, Parser]:
    """Return the parser of every verb by name."""
    actions = fleet_parser(command_modules())._actions
    (verbs,) = (action for action in actions if isinstance(action, argparse._SubParsersAction))
    return dict(sorted(verbs.choices.items()))


def _words(parser: Parser) -> str:
    return " ".join((*parser.option_strings(), *_choices(parser)))


def _choices(parser: Parser) -> list[str]:
    """Return the words that a position of the command line accepts."""
    return [str(word) for action in parser._actions if not action.option_strings for word in action.choices or ()]


def bash(verbs: dict[str, Parser]) -> str:
    """Return the script for bash."""
    cases = "".join(f'    {name}) words="{_words(parser)}" ;;\n' for name, parser in verbs.items())
    return f"""_fleet() {{
  local words="{" ".join(verbs)} --help --version"
  [ "$COMP_CWORD" -gt 1 ] && case "${{COMP_WORDS[1]}}" in
{cases}    *) words="" ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "${{COMP_WORDS[COMP_CWORD]}}"))
}}
complete -o default -F _fleet fleet
"""


def zsh(verbs: dict[str, Parser]) -> str:
    """Return the script for zsh."""
    cases = "".join(f"    {name}) compadd -- {_words(parser)}; _files ;;\n" for name, parser in verbs.items())
    return f"""#compdef fleet
if (( CURRENT == 2 )); then
  compadd -- {" ".join(verbs)} --help --version
else
  case $words[2] in
{cases}  esac
fi
"""


def fish(verbs: dict[str, Parser]) -> str:
    """Return the script for fish."""
    lines = [
        "complete -c fleet -n __fish_use_subcommand -l help",
        "complete -c fleet -n __fish_use_subcommand -l version",
    ]
    for name, parser in verbs.items():
        lines.append(f"complete -c fleet -n __fish_use_subcommand -f -a {name}")
        condition = f"complete -c fleet -n '__fish_seen_subcommand_from {name}'"
        lines += [f"{condition} -l {option[2:]}" for option in parser.option_strings() if option.startswith("--")]
        lines += [f"{condition} -f -a {word}" for word in _choices(parser)]
    return "\n".join((*lines, ""))


SCRIPTS = {"bash": bash, "zsh": zsh, "fish": fish}
