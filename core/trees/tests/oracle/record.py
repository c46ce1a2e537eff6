#!/usr/bin/env python3
"""Records what the real library answers, for the tests of the crate.

    pip install behaviortreepy==0.1.4     # BehaviorTree.CPP 4.8.2
    record.py cases > cases.jsonl         # the study's cases, one JSON object a line
    record.py random 0 2000 > random.z    # random trees, the same lines, compressed by zlib
    record.py fresh 5000 6000             # random trees, not compressed, for a test that reads them
    record.py model FILE                  # loads a file, and says whether the library takes it
    record.py later | record | record.py pack > later.z    # what 4.10.0 answers: see record.cpp

A line is the request (XML, leaves with the answers that they give in turn, what is written into the
blackboard before which tick, when the tree is halted) with the library's answer in "answers": for
each tick the status, the calls of leaves as `path:start|run|tick:answer` or `path:halt`, and the
watched values. `error` is where the library threw.

The generator makes valid trees without what later versions changed: no timers, no arithmetic whose
grouping changed, no literals of subtrees. A tree that is halted as a whole has no `_onHalted`, which
the library runs twice then (see differences.md).
"""
import json
import os
import random
import sys
import zlib

try:
    import behaviortreepy as b
    N = b.NodeStatus
    TO = {"S": N.SUCCESS, "F": N.FAILURE, "R": N.RUNNING, "K": N.SKIPPED}
    FROM = {N.SUCCESS: "S", N.FAILURE: "F", N.RUNNING: "R", N.SKIPPED: "K", N.IDLE: "I"}
except ImportError:
    pass  # `later` and `pack` do without.

TYPES = ["Sequence", "Fallback", "ReactiveSequence", "ReactiveFallback", "SequenceWithMemory",
         "AsyncSequence", "AsyncFallback", "Parallel", "ParallelAll", "IfThenElse", "WhileDoElse",
         "Switch2", "Inverter", "ForceSuccess", "ForceFailure", "Repeat", "RetryUntilSuccessful",
         "KeepRunningUntilFailure", "RunOnce", "Precondition", "LoopInt"]


class Leaves:
    def __init__(self, spec):
        self.spec, self.position, self.calls = spec, {}, []

    def step(self, name, node, what):
        leaf = self.spec[name]
        path = node.full_path()
        i = self.position.get(path, 0)
        self.position[path] = i + 1
        script = leaf["script"]
        c = script[i % len(script)] if leaf.get("loop") else script[min(i, len(script) - 1)]
        self.calls.append(f"{path}:{what}:{c}")
        if c == "X":
            raise RuntimeError("the leaf's own")
        return TO[c]

    def register(self, factory):
        for name, leaf in self.spec.items():
            if leaf["kind"] == "action":
                factory.register_simple_stateful_action(
                    name,
                    lambda n, name=name: self.step(name, n, "start"),
                    lambda n, name=name: self.step(name, n, "run"),
                    lambda n: self.calls.append(f"{n.full_path()}:halt"))
            elif leaf["kind"] == "sync":
                factory.register_simple_action(name, lambda n, name=name: self.step(name, n, "tick"))
            else:
                factory.register_simple_condition(
                    name, lambda n, name=name: self.step(name, n, "tick"))


def run(request):
    """The request with the library's answers."""
    leaves = Leaves(request["leaves"])
    answers = []
    done = dict(request, answers=answers)
    try:
        factory = b.BehaviorTreeFactory()
        leaves.register(factory)
        tree = factory.create_tree_from_text(request["xml"])
    except Exception as error:
        return dict(done, error="load", text=str(error))
    board = tree.root_blackboard()
    tick = tree.tick_once if request.get("mode") == "once" else tree.tick_exactly_once
    for i in range(request["ticks"]):
        leaves.calls = []
        try:
            for key, kind, value in request.get("set_before", {}).get(str(i), []):
                getattr(board, "set_" + kind)(key, value)
            if i in request.get("halt_at", []):
                tree.halt_tree()
                answers.append(["H", list(leaves.calls), {}])
                continue
            status = FROM[tick()]
        except Exception as error:
            return dict(done, error="tick", text=str(error))
        watched = {}
        for key, kind in request.get("watch", []):
            try:
                watched[key] = getattr(board, "get_" + kind)(key)
            except Exception:
                watched[key] = None
        answers.append([status, list(leaves.calls), watched])
    return done


def generate(seed, depth=4, ticks=12, types=TYPES):
    """A random valid tree as a request."""
    r = random.Random(seed)
    leaves, variables = {}, ["p", "q", "s"]
    mode = r.choice(["exactly_once", "once"])
    halt_at = [t for t in range(1, ticks) if r.random() < 0.05]
    after = ["_onSuccess", "_onFailure", "_post"] + ([] if halt_at else ["_onHalted"])

    def leaf(kinds):
        kind = r.choice(kinds)
        weights = [("S", 3), ("F", 2)] + ([("R", 4)] if kind == "action" else [])
        letters, counts = zip(*weights)
        name = f"L{len(leaves)}"
        script = "".join(r.choices(letters, counts)[0] for _ in range(r.randint(1, 6)))
        leaves[name] = dict(kind=kind, script=script, loop=True)
        return name

    def conditions():
        if r.random() > 0.2:
            return ""
        name = r.choice(["_skipIf", "_successIf", "_failureIf", "_while"])
        text = f' {name}="{r.choice(["", "!"])}{r.choice(variables)}"'
        return text + (f' {r.choice(after)}="n += 1"' if r.random() < 0.3 else "")

    def children(depth, count):
        return "".join(node(depth - 1) for _ in range(count))

    def node(depth):
        if depth <= 0 or r.random() < 0.25:
            return f"<{leaf(['action', 'action', 'sync', 'condition'])}{conditions()}/>"
        kind = r.choice(types)
        own = conditions()
        if kind in TYPES[:7]:
            inner = children(depth, r.randint(1, 4))
            if kind == "ReactiveSequence":  # more than one AsyncSequence below it is refused
                inner = inner.replace("<AsyncSequence", "<Sequence")
                inner = inner.replace("</AsyncSequence", "</Sequence")
            return f"<{kind}{own}>{inner}</{kind}>"
        if kind in ("Parallel", "ParallelAll"):
            n = r.randint(1, 4)
            least = r.choice([-1, -1, r.randint(1, n)])
            ports = f'success_count="{least}" failure_count="{r.randint(1, n)}"'
            if kind == "ParallelAll":
                ports = f'max_failures="{r.randint(1, n)}"'
            return f"<{kind} {ports}{own}>{children(depth, n)}</{kind}>"
        if kind == "TryCatch":
            port = f'catch_on_halt="{r.choice(["true", "false"])}"'
            return f"<TryCatch {port}{own}>{children(depth, r.randint(2, 4))}</TryCatch>"
        if kind in ("IfThenElse", "WhileDoElse"):
            # A condition that is skipped throws, so it has no conditions of its own.
            first = leaf(["condition", "sync", "action"])
            return f"<{kind}{own}><{first}/>{children(depth, r.randint(1, 2))}</{kind}>"
        if kind == "Switch2":
            ports = 'variable="{sw}" case_1="1" case_2="2"'
            return f"<Switch2 {ports}{own}>{children(depth, 3)}</Switch2>"
        ports = {
            # -1 over a child that is done at once would never return from `tick_once`.
            "Repeat": lambda: f' num_cycles="{r.randint(0, 3)}"',
            "RetryUntilSuccessful": lambda: f' num_attempts="{r.randint(0, 3)}"',
            "RunOnce": lambda: f' then_skip="{r.choice(["true", "false"])}"',
            "Precondition": lambda: f' if="{r.choice(variables)}" else="{r.choice(["FAILURE", "SUCCESS", "RUNNING", "SKIPPED"])}"',
            "LoopInt": lambda: f' queue="{";".join(str(i) for i in range(r.randint(1, 3)))}" value="{{v}}"',
        }.get(kind, lambda: "")()
        return f"<{kind}{ports}{own}>{children(depth, 1)}</{kind}>"

    body = node(depth)
    before = {str(t): [[v, "bool", r.random() < 0.5] for v in variables]
              + [["sw", "string", r.choice("123")]] for t in range(ticks)}
    before["0"].append(["n", "int", 0])
    xml = f'<root BTCPP_format="4"><BehaviorTree ID="M">{body}</BehaviorTree></root>'
    return dict(title=str(seed), xml=xml, leaves=leaves, ticks=ticks, mode=mode, halt_at=halt_at,
                set_before=before, watch=[["n", "int"]])


def line(request):
    return json.dumps(run(request), separators=(",", ":")) + "\n"


def later():
    """Requests for the library's version 4.10.0: by hand, and random trees with many TryCatch."""
    from cases import LATER
    types = TYPES + 5 * ["TryCatch"]
    return [request for request, _ in LATER] + [generate(seed, types=types) for seed in range(500)]


def main():
    # The library prints warnings on standard output.
    real = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    what = sys.argv[1]
    if what == "cases":
        from cases import CASES
        for request, expected in CASES:
            text = line(request)
            statuses = "".join(answer[0] for answer in json.loads(text)["answers"])
            if expected not in (None, statuses):
                print(f"{request['title']}: {statuses}, not {expected}", file=sys.stderr)
            real.write(text.encode())
    elif what == "later":
        real.writelines(json.dumps(request).encode() + b"\n" for request in later())
    elif what == "pack":
        real.write(zlib.compress(sys.stdin.buffer.read(), 9))
    elif what == "model":
        factory = b.BehaviorTreeFactory()
        factory.create_tree_from_text(open(sys.argv[2]).read())
        real.write(b"taken\n")
    else:
        lines = "".join(line(generate(seed)) for seed in range(int(sys.argv[2]), int(sys.argv[3])))
        real.write(zlib.compress(lines.encode(), 9) if what == "random" else lines.encode())
    real.flush()


if __name__ == "__main__":
    main()
