"""What a saved result is worth today: by the commit that it names, and the sources on its path."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from experiments.common.registry import EXPERIMENTS, Entry
from experiments.common.result import ROOT, sealed_seed
from experiments.common.standing import Standing, Verdict, changed_since, has_history, judge, marked, meaning

ENTRY = Entry("?", "m", ("plant", "law.py"))
CODE = '"""Doc."""\n\nX = 1\n"""Of X."""\n\n\ndef f(a):\n    """Doc."""\n    return a  # why\n'


class Checkout:
    """A small git checkout."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.git("init", "-q")
        self.write("plant/steel.py", CODE)
        self.write("law.py", "GAIN = 2\n")
        self.write("docs/page.md", "old\n")
        self.commit = self.save()

    def git(self, *arguments: str) -> str:
        identity = ("-c", "user.name=a", "-c", "user.email=a@b.c")
        done = subprocess.run(["git", "-C", str(self.root), *identity, *arguments], capture_output=True, check=True)
        return done.stdout.decode().strip()

    def write(self, name: str, text: str) -> None:
        (self.root / name).parent.mkdir(exist_ok=True)
        (self.root / name).write_text(text)

    def save(self) -> str:
        self.git("add", "-A")
        self.git("commit", "-qm", "x")
        return self.git("rev-parse", "--short=12", "HEAD")

    def judge(self, commit: str = "") -> Verdict:
        changed_since.cache_clear()
        return judge(commit or self.commit, ENTRY, self.root)


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_a_result_is_current_until_a_source_on_its_path_changes(checkout: Checkout) -> None:
    assert checkout.judge() == Verdict(Standing.CURRENT)
    checkout.write("docs/page.md", "new\n")
    checkout.write("other.py", "A = 1\n")
    checkout.save()
    assert checkout.judge().standing is Standing.CURRENT
    checkout.write("law.py", "GAIN = 3\n")
    assert checkout.judge().changed == ("law.py",), "before it is committed as well"
    checkout.save()
    found = checkout.judge()
    assert found.standing is Standing.STALE and checkout.commit in found.why


def test_words_and_layout_are_no_change_and_every_number_is(checkout: Checkout) -> None:
    checkout.write("plant/steel.py", '"""Other."""\nX = 1\n"""Said otherwise."""\ndef f(a):  # so\n    return a\n')
    assert checkout.judge().standing is Standing.CURRENT
    checkout.write("plant/steel.py", CODE.replace("X = 1", "X = 2"))
    assert checkout.judge().standing is Standing.STALE


def test_of_a_module_that_also_evaluates_the_named_definitions_count_alone(checkout: Checkout) -> None:
    entry = Entry("?", "m", ("plant/steel.py:f,X",))
    for code, standing in (
        (CODE + "\n\ndef evaluate(a):\n    return a + 1\n", Standing.CURRENT),
        (CODE.replace("return a", "return -a"), Standing.STALE),
        (CODE.replace("X = 1", "X = 2"), Standing.STALE),
        (CODE.replace("X = 1", ""), Standing.STALE),
    ):
        checkout.write("plant/steel.py", code)
        changed_since.cache_clear()
        assert judge(checkout.commit, entry, checkout.root).standing is standing, code


def test_new_moved_and_deleted_sources_and_weights_count(checkout: Checkout) -> None:
    checkout.write("plant/weights.onnx", "1")
    (checkout.root / "law.py").rename(checkout.root / "plant" / "law.py")
    checkout.save()
    assert checkout.judge().changed == ("law.py", "plant/law.py", "plant/weights.onnx")


def test_a_commit_that_is_not_in_the_history_or_was_never_one_is_told(checkout: Checkout) -> None:
    checkout.git("checkout", "-q", "-b", "aside")
    checkout.write("law.py", "GAIN = 5\n")
    aside = checkout.save()
    checkout.git("checkout", "-q", "-")
    for commit in (aside, "0123456789ab", "unknown", f"{checkout.commit}+changes"):
        assert checkout.judge(commit).standing is Standing.UNVERIFIABLE, commit


def test_a_page_says_what_its_result_is_worth() -> None:
    page = "# Title\n\nConclusion.\n"
    assert marked(page, Verdict(Standing.CURRENT)) == page
    stale = marked(page, Verdict(Standing.STALE, "It is old."))
    assert stale.startswith("# Title\n\n") and "It is old." in stale and stale.endswith("\n\nConclusion.\n")


def test_every_source_of_every_experiment_exists() -> None:
    for name, entry in EXPERIMENTS.items():
        folder = entry.module.rsplit(".", 1)[0].replace(".", "/")
        assert any(source.startswith(folder) for source in entry.sources), name
        for path, _, names in (source.partition(":") for source in entry.sources):
            assert (ROOT / path).exists(), (name, path)
            for definition in filter(None, names.split(",")):
                of_it = meaning((ROOT / path).read_bytes(), frozenset({definition}))
                assert of_it != meaning(b""), (name, definition)


def test_a_shallow_checkout_and_a_copy_are_told_from_a_whole_one(checkout: Checkout, tmp_path: Path) -> None:
    assert not has_history(checkout.root), "one commit that holds everything"
    checkout.write("law.py", "GAIN = 3\n")
    checkout.save()
    assert has_history(checkout.root) and not has_history(tmp_path.parent)
    shallow = tmp_path / "shallow"
    checkout.git("clone", "-q", "--depth", "1", f"file://{checkout.root}", str(shallow))
    assert not has_history(shallow)


def test_a_sealed_seed_is_drawn_from_the_commit_and_lies_beyond_those_that_people_choose() -> None:
    seeds = {sealed_seed(f"{n:012x}", name) for n in range(100) for name in ("plant", "navigation")}
    assert len(seeds) == 200 and min(seeds) >= 100_000 and max(seeds) * 1000 < 2**32
    assert sealed_seed("0123456789ab", "plant") == sealed_seed("0123456789ab", "plant") == 101838
