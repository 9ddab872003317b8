"""The examples in docstrings: they print what they say, and no public part of these modules lacks one."""

import ast
import doctest
import pkgutil
from importlib import import_module
from pathlib import Path

import pytest

import rcnn_odom
from rcnn_odom import matching

MODULES = [
    "rcnn_odom.geometry",
    "rcnn_odom.compiled",
    "rcnn_odom.options",
    "rcnn_odom.registry",
    "rcnn_odom.evaluation.drift",
    "rcnn_odom.evaluation.relations",
    "rcnn_odom.evaluation.sweep_report.statistics",
    *(f"{matching.__name__}.{module.name}" for module in pkgutil.iter_modules(matching.__path__)),
    "rcnn_odom.models.matcher",
    "rcnn_odom.deployment.odometer",
]
PACKAGE = Path(rcnn_odom.__file__).parent
SOME_EXAMPLES = sorted(
    name
    for file in PACKAGE.rglob("*.py")
    if ">>>" in file.read_text(encoding="utf-8")
    and (name := ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"))
    not in MODULES
)
"""Modules whose examples are run, although not every public part has one."""
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def parse(module):
    return ast.parse(Path(module.__file__).read_text(encoding="utf-8"))


def public_parts(tree):
    """Public functions, classes and methods as (node, node of the class or None); no properties.

    They are read from the source, so that decorators make no difference.
    """
    for node in public(tree):
        yield node, None
        if isinstance(node, ast.ClassDef):
            for method in public(node):
                if not any("property" in ast.unparse(mark) for mark in method.decorator_list):
                    yield method, node


def public(node):
    """The functions and classes of a module or class whose names do not begin with an underscore."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    return [part for part in node.body if isinstance(part, kinds) and not part.name.startswith("_")]


def examples(node):
    """The examples in the docstring of a function or class."""
    return doctest.DocTestParser().get_examples(ast.get_docstring(node) or "")


def without_example(tree):
    """Names of the public parts without an example; the example of a class also counts for what it calls."""
    for node, owner in public_parts(tree):
        shown_by_class = owner and any(f".{node.name}(" in example.source for example in examples(owner))
        if not examples(node) and not shown_by_class:
            yield f"{owner.name}.{node.name}" if owner else node.name


@pytest.mark.parametrize("name", [*MODULES, *SOME_EXAMPLES])
def test_examples_print_what_they_say(name):
    module = import_module(name)
    runner = doctest.DocTestRunner(optionflags=FLAGS)
    for node, _ in public_parts(parse(module)):
        names = dict(vars(module))
        runner.run(
            doctest.DocTest(examples(node), names, f"{name}.{node.name}", module.__file__, node.lineno, None)
        )
    assert runner.failures == 0, "the differences are printed above"


@pytest.mark.parametrize("name", MODULES)
def test_every_public_part_has_an_example(name):
    missing = list(without_example(parse(import_module(name))))
    assert not missing, f"{name}: give these an example (>>>) in their docstring"


SOURCE = '''
def shown():
    """
    >>> shown()
    """
def hidden(): "No example."
def _private(): "No example."
class Room:
    """
    >>> Room().walls()
    """
    def __len__(self): return 4
    def walls(self): "Shown by the class."
    def doors(self): "No example."
    @property
    def area(self): "No example."
'''


def test_parts_without_an_example_are_found():
    assert list(without_example(ast.parse(SOURCE))) == ["hidden", "Room.doors"]
