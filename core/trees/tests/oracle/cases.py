"""The study's cases of BehaviorTree.CPP semantics, with the statuses that it expects (or None)."""


def X(body, extra=""):
    head = '<root BTCPP_format="4" main_tree_to_execute="M"><BehaviorTree ID="M">'
    return f"{head}{body}</BehaviorTree>{extra}</root>"


def A(s, **k):
    return dict(kind="action", script=list(s), **k)


def C(s, **k):
    return dict(kind="condition", script=list(s), **k)


def Y(s, **k):
    return dict(kind="sync", script=list(s), **k)


CASES = []


def case(title, body, leaves, ticks, expect=None, extra="", **kw):
    request = dict(title=title, xml=X(body, extra), leaves=leaves, ticks=ticks, **kw)
    CASES.append((request, expect))


case("01 Sequence does not look again at its condition", '<Sequence><C/><A/></Sequence>',
     dict(C=C("SF"), A=A("RRS")), 3, "RRS")
case("01b ReactiveSequence does", '<ReactiveSequence><C/><A/></ReactiveSequence>',
     dict(C=C("SF"), A=A("RRS")), 3, "RFF")
case("02 SequenceWithMemory resumes at the failed child, also after halt", '<SequenceWithMemory><C/><A/></SequenceWithMemory>',
     dict(C=C("S"), A=A("FRS")), 4, None, halt_at=[2])
case("02b SequenceWithMemory with a sync first child yields RUNNING (wake-up)", '<SequenceWithMemory><Y/><Z/></SequenceWithMemory>',
     dict(Y=Y("S"), Z=Y("S")), 3, "RSR")
case("02c Sequence does not", '<Sequence><Y/><Z/></Sequence>', dict(Y=Y("S"), Z=Y("S")), 2, "SS")
case("02d AsyncSequence, exactly once", '<AsyncSequence><Y/><Z/></AsyncSequence>', dict(Y=Y("S"), Z=Y("S")), 4, "RSRS")
case("02e AsyncSequence, tick_once (wake-up loop)", '<AsyncSequence><Y/><Z/></AsyncSequence>', dict(Y=Y("S"), Z=Y("S")), 2, "SS", mode="once")
case("03 Sequence counts SKIPPED; partly skipped is SUCCESS", '<Sequence><Y _skipIf="true"/><Z/></Sequence>', dict(Y=Y("S"), Z=Y("S")), 1, "S")
case("03b all skipped is SKIPPED at the root", '<Sequence><Y _skipIf="true"/><Z _skipIf="true"/></Sequence>', dict(Y=Y("S"), Z=Y("S")), 2, "KK")
case("04 Parallel -1/1 with a skipped child, then not skipped", '<Parallel success_count="-1" failure_count="1"><Y _skipIf="skip"/><A/></Parallel>',
     dict(Y=Y("S"), A=A("RRS")), 3, "RRS", set_before={"0": [["skip", "bool", True]], "1": [["skip", "bool", False]]})
case("04b Parallel success_count=1 with failure_count=-1", '<Parallel success_count="2" failure_count="2"><Y/><Z/><A/></Parallel>',
     dict(Y=Y("F"), Z=Y("F"), A=A("R")), 1, "F")
case("04c Parallel stops at the threshold, later children are not ticked", '<Parallel success_count="1" failure_count="-1"><Y/><Z/></Parallel>',
     dict(Y=Y("S"), Z=Y("S")), 1, "S")
case("04d ParallelAll ticks all, then decides", '<ParallelAll max_failures="1"><Y/><A/></ParallelAll>', dict(Y=Y("F"), A=A("RS")), 2, "RF")
case("04e Parallel skipped_count=1 of 2, skipped child first, other RUNNING", '<Parallel success_count="1"><Y _skipIf="true"/><A/></Parallel>', dict(Y=Y("S"), A=A("RS")), 2, None)
case("04f Parallel success_count=-2, failed first child", '<Parallel success_count="-2" failure_count="2"><Y _skipIf="true"/><Z/><A/></Parallel>', dict(Y=Y("S"), Z=Y("S"), A=A("RS")), 2, None)
case("05 _skipIf is not looked at while RUNNING", '<A _skipIf="stop"/>', dict(A=A("RRS")), 3, "RRS", set_before={"0": [["stop", "bool", False]], "1": [["stop", "bool", True]]})
case("05b _while is; false halts and answers SKIPPED", '<A _while="go" _onHalted="h:=1"/>', dict(A=A("RRS")), 3, None,
     set_before={"0": [["go", "bool", True]], "1": [["go", "bool", False]]}, watch=[["h", "int"]])
case("05c order: _failureIf before _successIf before _skipIf; _onFailure and _post run though tick did not",
     '<Y _skipIf="true" _successIf="true" _failureIf="true" _onFailure="a:=1" _post="p:=1" _onSuccess="s:=1"/>', dict(Y=Y("S")), 1, "F", watch=[["a", "int"], ["p", "int"], ["s", "int"]])
case("05d status after a _successIf answer: next tick of the same node under Sequence", '<Sequence><Y _successIf="x"/><A/></Sequence>', dict(Y=Y("F"), A=A("RS")), 2, None, set_before={"0": [["x", "bool", True]]})
case("05e root leaf ticked again after completion is not IDLE? preconditions", '<Y _failureIf="x"/>', dict(Y=Y("S")), 3, None, set_before={"0": [["x", "bool", False]], "1": [["x", "bool", True]]})
case("05f _skipIf and SKIPPED: no post-conditions", '<Y _skipIf="true" _post="p:=1"/>', dict(Y=Y("S")), 1, "K", watch=[["p", "int"]])
case("06 Repeat with a sync child: one cycle per tick (exactly once)", '<Repeat num_cycles="3"><Y/></Repeat>', dict(Y=Y("S")), 4, "RRSR")
case("06b Repeat with tick_once: all cycles in one call", '<Repeat num_cycles="3"><Y/></Repeat>', dict(Y=Y("S")), 2, None, mode="once")
case("06c Repeat with an async child that ran: goes on in the same tick", '<Repeat num_cycles="3"><A/></Repeat>', dict(A=A("RSRS", loop=True)), 4, "RRRS")
case("06d Repeat: SKIPPED child keeps the counter", '<Repeat num_cycles="2"><Y _skipIf="k"/></Repeat>', dict(Y=Y("S")), 4, None,
     set_before={"0": [["k", "bool", False]], "1": [["k", "bool", True]], "2": [["k", "bool", False]]})
case("06e Repeat num_cycles=0", '<Repeat num_cycles="0"><Y/></Repeat>', dict(Y=Y("S")), 1, "S")
case("06f Retry num_attempts=0", '<RetryUntilSuccessful num_attempts="0"><Y/></RetryUntilSuccessful>', dict(Y=Y("S")), 1, "F")
case("06g Retry: one attempt per tick", '<RetryUntilSuccessful num_attempts="3"><Y/></RetryUntilSuccessful>', dict(Y=Y("F")), 4, None)
case("07 ReactiveFallback halts the lower running child when a higher one succeeds", '<ReactiveFallback><C/><A/></ReactiveFallback>', dict(C=C("FS"), A=A("RRS")), 2, "RS")
case("07b ReactiveSequence with two running children: earlier halted, later runs", '<ReactiveSequence><A/><B/></ReactiveSequence>', dict(A=A("RSRS", loop=True), B=A("R")), 3, "RRR")
case("07c ReactiveSequence re-ticks a finished async child from start", '<ReactiveSequence><A/><B/></ReactiveSequence>', dict(A=A("SRS"), B=A("R")), 4, None)
case("08 IfThenElse: condition not looked at again while the branch runs", '<IfThenElse><C/><A/><B/></IfThenElse>', dict(C=C("SF"), A=A("RS"), B=A("S")), 2, "RS")
case("08b WhileDoElse: looked at each tick, the left branch is halted", '<WhileDoElse><C/><A/><B/></WhileDoElse>', dict(C=C("SF"), A=A("RRS"), B=A("RS")), 3, None)
case("08c WhileDoElse with 2 children: FAILURE halts the branch", '<WhileDoElse><C/><A/></WhileDoElse>', dict(C=C("SF"), A=A("RRS")), 2, "RF")
case("08d IfThenElse with a SKIPPED condition throws", '<IfThenElse><C _skipIf="true"/><A/><B/></IfThenElse>', dict(C=C("S"), A=A("S"), B=A("S")), 1, None)
case("08e WhileDoElse with a SKIPPED condition", '<WhileDoElse><C _skipIf="true"/><A/><B/></WhileDoElse>', dict(C=C("S"), A=A("S"), B=A("S")), 1, None)
case("09 Switch: default, and the left branch is halted when the value changes", '<Switch2 variable="{v}" case_1="1" case_2="2"><A/><B/><D/></Switch2>',
     dict(A=A("R"), B=A("RS"), D=A("S")), 4, None, set_before={"0": [["v", "string", "1"]], "1": [["v", "string", "2"]], "3": [["v", "string", "9"]]})
case("09b Switch: numeric equality 1 == 1.0", '<Switch2 variable="1.0" case_1="1" case_2="2"><A/><B/><D/></Switch2>', dict(A=Y("S"), B=Y("F"), D=Y("F")), 1, "S")
case("09c Switch: trailing characters 1abc == 1 (before 4.10)", '<Switch2 variable="1abc" case_1="1" case_2="2"><A/><B/><D/></Switch2>', dict(A=Y("S"), B=Y("F"), D=Y("F")), 1, "S")
case("10 RunOnce: SKIPPED after the first; halt does not reset it", '<RunOnce><Y/></RunOnce>', dict(Y=Y("F")), 4, "FKHK", halt_at=[2])
case("10b RunOnce then_skip=false", '<RunOnce then_skip="false"><Y/></RunOnce>', dict(Y=Y("F")), 2, "FF")
case("11 KeepRunningUntilFailure: SUCCESS becomes RUNNING, skipped child too", '<KeepRunningUntilFailure><Y _skipIf="k"/></KeepRunningUntilFailure>', dict(Y=Y("SF")), 3, "RRF",
     set_before={"0": [["k", "bool", True]], "1": [["k", "bool", False]]})
case("12 Loop: RUNNING after each element, also the last", '<LoopInt queue="1;2" value="{v}"><Y/></LoopInt>', dict(Y=Y("S")), 4, "RRSR", watch=[["v", "int"]])
case("13 Precondition node: not re-evaluated while the child runs", '<Precondition if="x" else="FAILURE"><A/></Precondition>', dict(A=A("RS")), 3, None,
     set_before={"0": [["x", "bool", True]], "1": [["x", "bool", False]]})
case("13b Precondition: flag survives halt", '<Precondition if="x" else="FAILURE"><A/></Precondition>', dict(A=A("RS")), 3, None, halt_at=[1],
     set_before={"0": [["x", "bool", True]], "1": [["x", "bool", False]]})
case("14 SetBlackboard then script: string entry, comparison with a number", '<Sequence><SetBlackboard value="42" output_key="n"/><ScriptCondition code="n == 42"/></Sequence>', {}, 1, None)
case("14b Script precedence: a - b - c", '<ScriptCondition code="10 - 5 - 2 == 3"/>', {}, 1, "F")
case("14c Script: assignment with = to an unknown key throws", '<Script code="x = 1"/>', {}, 1, None)
case("14d Script: string minus throws", "<Script code=\"x := 'a' - 1\"/>", {}, 1, None)
case("14e Script: && is not short-circuit", '<ScriptCondition code="false &amp;&amp; nope"/>', {}, 1, None)
case("14f Script: type is fixed by the first assignment", "<Script code=\"x := 1; x := 'abc'\"/>", {}, 1, None)
case("15 SubTree: literal is set once, own scope; {=}", '<Sequence><Script code="a:=1; b:=2"/><SubTree ID="T" a="{=}" c="7"/><ScriptCondition code="a == 8"/></Sequence>',
     {}, 1, "S", extra='<BehaviorTree ID="T"><Sequence><ScriptCondition code="c == 7"/><Script code="a = a + 7"/></Sequence></BehaviorTree>')
case("15b SubTree without remapping does not see the parent", '<Sequence><Script code="a:=1"/><SubTree ID="T"/></Sequence>', {}, 1, None, extra='<BehaviorTree ID="T"><ScriptCondition code="a == 1"/></BehaviorTree>')
case("15c _autoremap, private key", '<Sequence><Script code="a:=1; _p:=1"/><SubTree ID="T" _autoremap="true"/></Sequence>', {}, 1, None, extra='<BehaviorTree ID="T"><Sequence><ScriptCondition code="a == 1"/><ScriptCondition code="_p == 1"/></Sequence></BehaviorTree>')
case("15d @ reaches the root", '<Sequence><Script code="a:=1"/><SubTree ID="T"/></Sequence>', {}, 1, "S", extra='<BehaviorTree ID="T"><ScriptCondition code="@a == 1"/></BehaviorTree>')
case("15e subtree literal in arithmetic (4.9.1 changed)", '<SubTree ID="T" c="7"/>', {}, 1, None, extra='<BehaviorTree ID="T"><ScriptCondition code="c + 1 == 8"/></BehaviorTree>')
case("16 leaf exception: tree state afterwards", '<Sequence><Y/><A/></Sequence>', dict(Y=Y("S"), A=A("XS")), 2, "FS")
case("17 Inverter over a skipped child; ForceFailure too", '<Inverter><Y _skipIf="true"/></Inverter>', dict(Y=Y("S")), 1, "K")
case("18 WasEntryUpdated: first look at an existing entry is SUCCESS", '<WasEntryUpdated entry="{e}"/>', {}, 4, None, set_before={"1": [["e", "int", 1]], "3": [["e", "int", 1]]})
case("18b WaitValueUpdate answers RUNNING, not halted child", '<WaitValueUpdate entry="{e}"><Y/></WaitValueUpdate>', dict(Y=Y("S")), 3, None, set_before={"1": [["e", "int", 1]]})
case("18c WaitValueUpdate halted while the child runs (4.9.0 fixed)", '<ReactiveSequence><C/><WaitValueUpdate entry="{e}"><A/></WaitValueUpdate></ReactiveSequence>', dict(C=C("SFS"), A=A("R")), 3, "RFR", set_before={"0": [["e", "int", 1]]})
case("19 Fallback resumes at the running child", '<Fallback><C/><A/></Fallback>', dict(C=C("FS"), A=A("RF")), 3, None)
case("20 halt order: halt_tree on Parallel of two running", '<Parallel success_count="2" failure_count="2"><A/><B/></Parallel>', dict(A=A("R"), B=A("R")), 3, None, halt_at=[1])
case("21 Sequence failing late resets all; calls", '<Sequence><Y/><A/><Z/></Sequence>', dict(Y=Y("S"), A=A("RS"), Z=Y("F")), 3, None)
case("22 tick after completion restarts", '<Sequence><Y/><A/></Sequence>', dict(Y=Y("S"), A=A("RS")), 4, None)
case("23 root decorator chain status after SKIPPED while RUNNING (_while inside Sequence)", '<Sequence><A _while="go"/><B/></Sequence>', dict(A=A("R"), B=A("S")), 2, None, set_before={"0": [["go", "bool", True]], "1": [["go", "bool", False]]})
case("24 SetBlackboard with an unset source", '<SetBlackboard value="{nope}" output_key="x"/>', {}, 1, None)
case("25 leaf returning SKIPPED from tick", '<Sequence><Y/><Z/></Sequence>', dict(Y=Y("K"), Z=Y("S")), 2, None)
case("26 ParallelAll max_failures=2, one failure of two", '<ParallelAll max_failures="2"><Y/><Z/></ParallelAll>', dict(Y=Y("F"), Z=Y("S")), 1, "S")
case("27 Sequence: skipped count carried over a RUNNING tick", '<Sequence><Y _skipIf="true"/><A/></Sequence>', dict(Y=Y("S"), A=A("RK")), 2, None)

# The rows of the document's table that are not above, each with its expected answers.
case("T3 SequenceWithMemory keeps its index over a halt", '<ReactiveSequence><C/><SequenceWithMemory><Y/><A/></SequenceWithMemory></ReactiveSequence>', dict(C=C("SSFS"), Y=Y("S"), A=A("R")), 5, "RRFRR")
case("T4 Repeat, sync", '<Repeat num_cycles="3"><Y/></Repeat>', dict(Y=Y("S")), 3, "RRS")
case("T5 _while", '<A _while="!x"/>', dict(A=A("RRS")), 2, "RK", set_before={"0": [["x", "bool", False]], "1": [["x", "bool", True]]})
case("T6 a skipped composite stays RUNNING", '<Sequence _failureIf="x"><Y _skipIf="true"/></Sequence>', dict(Y=Y("S")), 3, "KKK", set_before={"0": [["x", "bool", False]], "1": [["x", "bool", True]]})
case("T6b a skipped leaf does not", '<Y _skipIf="k" _failureIf="x"/>', dict(Y=Y("S")), 3, "KFF", set_before={"0": [["x", "bool", False], ["k", "bool", True]], "1": [["x", "bool", True]]})
case("T7 IfThenElse freezes a stateful condition", '<IfThenElse><A/><Y/></IfThenElse>', dict(A=A("FS"), Y=Y("S")), 3, "FFF")
case("T8 WhileDoElse freezes a stateful condition", '<WhileDoElse><B/><A/></WhileDoElse>', dict(B=A("SRS"), A=A("R")), 3, "RRR")
case("T12 Precondition memory survives halt", '<Precondition if="x" else="FAILURE"><A/></Precondition>', dict(A=A("RS")), 3, "RHS", halt_at=[1], set_before={"0": [["x", "bool", True]], "1": [["x", "bool", False]]})
case("T13 skip count over RUNNING", '<Sequence><Y _skipIf="true"/><A/></Sequence>', dict(Y=Y("S"), A=A("RK")), 2, "RK")
case("T14 Retry keeps its count over SKIPPED", '<RetryUntilSuccessful num_attempts="2"><Y _skipIf="k"/></RetryUntilSuccessful>', dict(Y=Y("F")), 3, "RKF", set_before={"0": [["k", "bool", False]], "1": [["k", "bool", True]], "2": [["k", "bool", False]]})
case("T15 halt_tree runs _onHalted twice, and once on a node never started", '<Sequence><A _onHalted="h+=1"/><B _onHalted="g+=1"/></Sequence>', dict(A=A("R"), B=A("R")), 3, "RHR", halt_at=[1], watch=[["h", "int"], ["g", "int"]], set_before={"0": [["h", "int", 0], ["g", "int", 0]]})
case("T16 ParallelAll max_failures=-1, all fail", '<ParallelAll max_failures="-1"><Y/><Z/></ParallelAll>', dict(Y=Y("F"), Z=Y("F")), 1, "F")
case("T17 Precondition else=RUNNING is not looked at while the child runs", '<Precondition if="x" else="RUNNING"><A/></Precondition>', dict(A=A("RRS")), 3, "RRS", set_before={"0": [["x", "bool", True]], "1": [["x", "bool", False]]})
case("T18 erased and re-created entry is not 'updated'", '<Sequence><SetBlackboard value="1" output_key="e"/><WasEntryUpdated entry="e"/><UnsetBlackboard key="e"/></Sequence>', {}, 2, "SF")

# What came after 4.8.2, or is not in random trees: answered by 4.10.0.
OLDER, CASES = CASES, []

TRY = dict(A=A("RSRF", loop=True), B=A("RS", loop=True), Y=Y("SSF", loop=True))
case("TryCatch", '<TryCatch><Y/><A/><B/></TryCatch>', TRY, 12)
case("TryCatch, halted", '<TryCatch><Y/><A/><B/></TryCatch>', TRY, 12, halt_at=[1, 4, 6, 9])
case("TryCatch, catching halts", '<TryCatch catch_on_halt="true"><Y/><A/><B/></TryCatch>', TRY, 12, halt_at=[1, 4, 6, 9])
case("TryCatch, skipped", '<TryCatch><Y _skipIf="true"/><A _skipIf="true"/><B/></TryCatch>', TRY, 2)
case("TryCatch, skipped catch", '<TryCatch><Y/><B _skipIf="true"/></TryCatch>', dict(Y=Y("F"), B=A("S")), 2)
case("TryCatch, left by a reactive parent", '<ReactiveFallback><C/><TryCatch catch_on_halt="true"><A/><B/></TryCatch></ReactiveFallback>',
     dict(C=C("FFSF", loop=True), A=A("RRRF", loop=True), B=A("RSR", loop=True)), 12)
case("WaitValueUpdate, halted", '<ReactiveSequence><C/><WaitValueUpdate entry="{e}"><A/></WaitValueUpdate></ReactiveSequence>',
     dict(C=C("SFS", loop=True), A=A("R")), 6, set_before={"0": [["e", "int", 1]], "4": [["e", "int", 1]]})
T = '<BehaviorTree ID="T">%s</BehaviorTree>'
case("literal of a subtree", '<SubTree ID="T" i="7" r="0.5" t="1;2"/>', {}, 1,
     extra=T % '<ScriptCondition code="i + 1 == 8 &amp;&amp; r * 2 == 1 &amp;&amp; t == \'1;2\'"/>')
case("literal beside autoremap", '<Sequence><Script code="c := 1"/><SubTree ID="T" c="7" _autoremap="true"/><ScriptCondition code="c == 1 &amp;&amp; d == 7"/></Sequence>', {}, 1,
     extra=T % '<Script code="d := c; c = 8"/>')
case("created in a subtree", '<Sequence><SubTree ID="T" shared="{outer}"/><ScriptCondition code="outer == 2"/></Sequence>', {}, 1,
     extra=T % '<Script code="mine := 1; shared := 2"/>')
case("SetBlackboard copies a type", '<Sequence><Script code="a := 1.5"/><SetBlackboard value="{a}" output_key="b"/><ScriptCondition code="b * 2 == 3"/></Sequence>', {}, 2)
case("SetBlackboard by a name in an entry", '<Sequence><Script code="name := \'named\'"/><SetBlackboard value="9" output_key="{name}"/><ScriptCondition code="named == 9"/></Sequence>', {}, 2)
case("Loop over a text", '<Sequence><Script code="q := \'1;2\'"/><LoopInt queue="{q}" value="{v}"><Y/></LoopInt></Sequence>', dict(Y=Y("S")), 5, watch=[["v", "int"]])

for code in """10 - 5 - 2 == 3
16 / 4 / 2 == 2
7 / 2 == 3.5
1 + 2 * 3 == 7
(1 + 2) * -3 == -9
0x1F == 31
2.5e1 == 25
~0 == -1
6 & 3 | 8
(6 ^ 3) == 5
1 | 2 == 3
1.5 & 1
true || false && false
2 && 1
0.5 && 1
!0.5
false && nope
1 < 2 < 3
3 > 2 > 2
(3 > 2) == 1
0.1 + 0.2 == 0.3
1 != 1.00000001
1 <= 1.00000001
1.00000001 <= 1
'a' + 'b' == 'ab'
'a' .. 1 .. 1.5 == 'a11.500000'
1..'a' == '1a'
'a' < 'b'
'2' == 2
'true' == 1
'a' == 1
'a' - 1
1 .. 2
-'a'
0 ? 1 : 1 == 1 ? 3 : 0
'text' ? 1 : 0
'' ? 1 : 0
x := y := 1
x := 1; x += 2; x *= 4; x -= 2; x /= 5; x == 2
x := 'a'; x += 'b'; x == 'ab'
x = 1
x += 1
x := 1; x = 2.5
x := 1; x := 'abc'
x := 1; x := '2'; x == 2
x := 1.5; x := '2'; x == 2
x := 'a'; x = 1
x := 1 x := 2;; x == 2
@x := 1; x == 1
1 / 0 > 1000
x := 1; x
'1'
2""".split("\n"):
    case("script " + code, '<ScriptCondition code="%s"/>' % code.replace("&", "&amp;").replace("<", "&lt;"), {}, 1)
for code in ["x := ", "x := (1", "x := 1 ? 2", "x := 1.", "x := 3foo", "x := 0xZ", "x := 1e", "x := 'abc", "x := #", ";"]:
    case("no script " + code, '<Script code="%s"/>' % code, {}, 1)
LATER, CASES = CASES, OLDER
