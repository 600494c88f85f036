"""Mutants of a source file: a comparison turned, + for -, a condition negated, a result None.

Mutants are within functions. Not mutated are formatted strings, joined texts, results of functions that are
declared to return None, and conditions on types that only a type checker reads.
"""

import ast
import difflib
from collections.abc import Iterator
from dataclasses import dataclass

TURNED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.LtE: ast.Gt,
    ast.Gt: ast.LtE,
    ast.GtE: ast.Lt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
"""Opposite of each comparison."""

SWAPPED: dict[type[ast.operator], type[ast.operator]] = {ast.Add: ast.Sub, ast.Sub: ast.Add}
"""Operators that take each other's place."""


@dataclass(frozen=True, order=True)
class SourceMutant:
    """A source file with one fault.

    Attributes:
        path: Path of the file in the tree.
        line: Line of the fault, from 1.
        start: Offset of the replaced text [bytes].
        end: Offset of its end [bytes].
        replacement: Text in its place.
        fault: Kind of the fault.
    """

    path: str
    line: int
    start: int
    end: int
    replacement: str
    fault: str

    def source(self, original: str) -> str:
        """Return the source of the file with the fault."""
        content = original.encode()
        return (content[: self.start] + self.replacement.encode() + content[self.end :]).decode()

    def diff(self, original: str) -> str:
        """Return the changed lines."""
        lines = difflib.unified_diff(
            original.splitlines(), self.source(original).splitlines(), n=0, lineterm=""
        )
        return "\n".join(line for line in list(lines)[2:] if not line.startswith("@@"))


def mutants_of(path: str, source: str) -> list[SourceMutant]:
    """Return all mutants of a source file, in the order of their lines."""
    offsets = [0]
    for line in source.encode().splitlines(keepends=True):
        offsets.append(offsets[-1] + len(line))

    def mutant(node: ast.expr, replacement: ast.expr, fault: str) -> SourceMutant:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start = offsets[node.lineno - 1] + node.col_offset
        end = offsets[node.end_lineno - 1] + node.end_col_offset
        return SourceMutant(path, node.lineno, start, end, f"({ast.unparse(replacement)})", fault)

    return sorted(mutant(*fault) for fault in _faults(ast.parse(source)))


def _faults(tree: ast.AST, in_function: bool = False) -> Iterator[tuple[ast.expr, ast.expr, str]]:
    """Yield expressions within functions, their replacements, and the kind of the fault."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Name) and node.id == "TYPE_CHECKING"):
            continue
        if in_function:
            yield from _faults_at(node)
        is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            # Defaults and annotations are evaluated outside the function.
            for statement in node.body:
                yield from _faults(ast.Module([statement], []), in_function=True)
        else:
            yield from _faults(node, in_function or is_function)


def _faults_at(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr, str]]:
    match node:
        case ast.Compare(ops=[operator, *others]) if type(operator) in TURNED:
            turned = ast.Compare(node.left, [TURNED[type(operator)](), *others], node.comparators)
            yield node, turned, "comparison turned"
        case ast.BinOp(op=operator) if type(operator) in SWAPPED and not (
            _is_text(node.left) or _is_text(node.right)
        ):
            yield node, ast.BinOp(node.left, SWAPPED[type(operator)](), node.right), "+ and - swapped"
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant) or value.value:
            yield value, ast.Constant(None), "result None"
        case _:
            pass
    match node:
        case ast.If(test=condition) | ast.While(test=condition) | ast.IfExp(test=condition):
            if not isinstance(condition, ast.Constant):
                yield condition, ast.UnaryOp(ast.Not(), condition), "condition negated"
        case ast.comprehension(ifs=conditions):
            for condition in conditions:
                yield condition, ast.UnaryOp(ast.Not(), condition), "condition negated"
        case _:
            pass


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))
