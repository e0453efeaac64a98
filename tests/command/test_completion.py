"""What a shell asks of the command."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from tree import run

import sb3_follow_object
from sb3_follow_object.command.cli import main


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    with pytest.raises(SystemExit) as stop:
        main(list(words))
    assert stop.value.code == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_shells_learn_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    script = printed(capsys, "--print-completion", shell)
    for word in ("train", "demo", "export", "report", "resume", "onnx"):
        assert word in script


def test_bash_completes_a_command_and_its_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "completion.bash"
    script.write_text(printed(capsys, "--print-completion", "bash"))

    def complete(*words: str) -> list[str]:
        line = " ".join(f"'{word}'" for word in words)
        code = f"source {script}; COMP_WORDS=({line}); COMP_CWORD={len(words) - 1}; "
        code += "$(complete -p sb3-follow-object | sed 's/.*-F \\([^ ]*\\).*/\\1/'); "
        code += 'echo "${COMPREPLY[@]}"'
        done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert complete("sb3-follow-object", "exp") == ["export"]
    assert complete("sb3-follow-object", "export", "--on") == ["--onnx"]


def test_a_reader_of_the_script_who_has_gone_is_no_traceback() -> None:
    read, write = os.pipe()
    os.close(read)
    words = [sys.executable, "-m", "sb3_follow_object", "--print-completion", "bash"]
    done = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert done.stderr in ("", "sb3-follow-object: Broken pipe\n")


def test_installed_command_and_module_say_the_packages_version(
    tmp_path: Path, bare_python: Callable[..., Path]
) -> None:
    python = bare_python(tmp_path / "venv")
    said = f"sb3-follow-object {sb3_follow_object.__version__}\n"
    assert run([str(python.parent / "sb3-follow-object"), "--version"], cwd=tmp_path) == said
    assert run([str(python), "-m", "sb3_follow_object", "--version"], cwd=tmp_path) == said
