"""The code and the documentation use the field's terms (docs/glossary.md), not the words that stood in their place."""

import ast
import re
from collections import Counter

from tests.documents import CONTRIBUTING, NOTEBOOKS, PAGES, ROOT, text_of

FOLDERS = ("retrieval", "robot", "indexes", "_touch_retrieval", "benchmarks", "integrations", "tests")
CODE = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py")) if path.name != "test_language.py"]
PAGE_CODE = sorted(path for ending in ("*.js", "*.html", "*.toml") for path in (ROOT / "retrieval").rglob(ending))

WORDS_OF_NAMES = {
    "halves": "partials, partial activations",
    "judge judged judges judging": "score, scored, rerank, FusionScorer",
    "pruner pruned": "candidate encoder",
    "winner winners": "exhaustive_top1",
    "asked asker": "query, request, requested, client",
    "settled": "operating point, chosen",
    "wanted": "options, requirements, expected",
    "looked looks": "stat_cache, appearance",
    "felt": "touched, contact, query",
    "described": "info",
    "believe believed belief": "posterior_probabilities",
    "dealt": "permuted",
    "taught untaught lesson lessons": "pretrained, trained",
    "faint": "low_contact",
    "untouched": "no_contact",
    "worn": "displaced",
    "deck": "permutation",
    "said told": "feedback, message, output, printed",
    "keeping kept": "history_writer, stored, cached",
    "most": "max",
    "guessed guesses": "top1, topn",
}
"""Words that are no part of a name in the code -> names to use instead."""

PHRASES = {
    r"\bhal(f|ves) of (a |the |each )?(photo|touch)(es|s)?\b": "partial activation",
    r"\b(touch|photo)( |_)hal(f|ves)\b": "partial activation",
    r"\bhalves\.npy\b": "partials.npy",
    r"\bpruner": "candidate encoder",
    r"\bjudg(e|es|ed|ing)\b": "score, rerank",
    r"\bwinners?\b": "exhaustive top-1",
    r"\bfirst guess(es)?\b": "top-1 accuracy, top-1",
    r"\bguess curves?\b": "top-n accuracy",
    r"\b(is|are|be|was|were|been) (asked|told|said to)\b": "name the action: queried, requested, reported, printed",
    r"\btold (in|by|apart|of|with|which|what|where|why|4\d\d|5\d\d)\b": "reported, distinguished, gets 429",
    r"\bdealt\b": "permuted, randomly assigned",
    r"\bby lot\b": "randomly assigned",
    r"\bst(and|ands|ood|anding) still\b": "frozen",
    r"\b(un)?taught\b": "trained, pretrained",
    r"\bfelt\b": "touched, in contact",
    r"\bfaint(est)?\b": "low-contact",
    r"\buntouched (gel|frame|touch|picture|image)s?\b": "no-contact frame",
    r"\bblur(red)? (control|touch|touches)\b": "low-pass control",
    r"\bworlds?\b(?! size)": "object set, scene, rig",
    r"\b(believe|believes|believed|belief)\b": "posterior probability",
    r"\blet(s|ting)? go\b": "close, release",
    r"\bcan be had\b": "is available",
    r"\bdear(er)?\b": "expensive, slow",
    r"\bwho(ever)? asked\b": "client",
    r"\bwhoever\b": "name who",
    r", of which\b": "two sentences",
    r"\bthat which\b": "name the thing",
    r"\bwhat (is|was|are) (asked|wanted|given|said|told|kept|judged|felt|seen)\b": "name the thing",
    r"\bso (much|many) as\b": "a plain number or condition",
    r"\bbeside (it|them|the|a|an|its|each)\b": "next to, in addition to, compared with",
    r"\bnot to be had\b": "not available",
}
"""Phrases of the former dialect -> what to write instead."""

ALLOWED = {
    ("robot/collection.py", "most_attempts"): "a key of recording.json, and recordings exist",
}
"""(file, name or matched text in lower case) -> why it stays. At most 20."""


def names(tree):
    """Every name that a module binds: modules, classes, functions, arguments, variables, attributes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno


def words(name):
    """The words of a name in snake case or camel case, in lower case."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def banned_names():
    replacements = {word: better for group, better in WORDS_OF_NAMES.items() for word in group.split()}
    for path in CODE:
        file = str(path.relative_to(ROOT))
        for name, line in [(path.stem, 1), *names(ast.parse(path.read_text("utf-8")))]:
            if name.startswith("test_"):
                continue  # a sentence: its phrases are checked
            for word in words(name):
                if word in replacements and (file, name) not in ALLOWED:
                    yield f"{file}:{line}: {name}: write {replacements[word]}"


def banned_phrases():
    for path in (*CODE, *PAGE_CODE, *PAGES, CONTRIBUTING, *NOTEBOOKS):
        file, text = str(path.relative_to(ROOT)), text_of(path)
        text = re.sub(r"(?<=\w)_(?=\w)", " ", text) if path.suffix == ".py" else text
        for phrase, better in PHRASES.items():
            for match in re.finditer(phrase, text, re.IGNORECASE):
                found = match[0].lower()
                if (file, found) not in ALLOWED:
                    yield f"{file}:{text[: match.start()].count(chr(10)) + 1}: {match[0]}: write {better}"


def test_no_name_in_the_code_has_a_replaced_word():
    found = list(banned_names())
    assert not found, "\n".join(found)


def test_no_text_has_a_phrase_of_the_former_dialect():
    found = list(banned_phrases())
    assert not found, "\n".join(found)


def test_few_exceptions_are_left_and_each_has_a_reason():
    assert len(ALLOWED) <= 20
    assert all(len(reason.split()) > 2 for reason in ALLOWED.values())


def test_no_two_classes_of_the_packages_share_a_name():
    classes = Counter(
        node.name
        for path in CODE
        if path.relative_to(ROOT).parts[0] not in ("benchmarks", "tests")
        for node in ast.walk(ast.parse(path.read_text("utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert not [name for name, count in classes.items() if count > 1]


def test_no_file_has_a_name_that_says_nothing_of_its_content():
    vague = {"base.py", "run.py", "references.py", "utils.py", "helpers.py"}
    assert not [str(path) for path in CODE if path.name in vague]


def test_the_checks_find_the_words_that_they_refuse():
    assert words("ScoredTouches") == ["scored", "touches"]
    assert words("MAX_HALVES_kept") == ["max", "halves", "kept"]
    tree = ast.parse("class A:\n    def b(self, c):\n        self.d = e = 1")
    assert sorted(name for name, _ in names(tree)) == ["A", "b", "c", "d", "e", "self"]
    assert any(re.search(phrase, "photos are judged by halves") for phrase in PHRASES)
