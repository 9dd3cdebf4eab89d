"""The command in a shell."""
import os
import subprocess
import sys

import pdavis_cv
from pdavis_cv.tools.main import COMMANDS, main


def test_the_package_runs_as_the_command():
    told = subprocess.run([sys.executable, "-P", "-m", "pdavis_cv", "--version"],
                          check=True, capture_output=True, text=True).stdout
    assert told == f"pdavis_cv {pdavis_cv.__version__}\n"


def test_a_shell_completes_commands_and_options(tmp_path):
    program = tmp_path / "pdavis"
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -P -m pdavis_cv "$@"\n')
    program.chmod(0o755)
    script = """eval "$(pdavis --completion)"
        COMP_WORDS=(pdavis con); COMP_CWORD=1; _pdavis; echo "${COMPREPLY[@]}"
        COMP_WORDS=(pdavis info --sc); COMP_CWORD=2; _pdavis; echo "${COMPREPLY[@]}"
        COMP_WORDS=(pdavis info run); COMP_CWORD=2; _pdavis; echo "${#COMPREPLY[@]}" """
    told = subprocess.run(
        ["bash", "-uc", script], check=True, capture_output=True, text=True,
        env={**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}",
             "ZSH_VERSION": ""}).stdout
    assert told.split("\n") == ["convert", "--scan", "0", ""]


def test_help_lists_every_command(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    for name, what in COMMANDS.items():
        assert f"{name} " in text
        assert what in text
