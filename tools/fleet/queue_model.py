"""How a queue of many heads would behave on some machines: a simulation from measured stage times.

    tiface status runs/* --json | python tools/fleet/queue_model.py --heads 1000 --slots 8 --preempt 4

Reads the seconds of stages of runs that are done, draws heads from them (whole heads, times a spread of machines and
captures), and lets them wait for slots as the fleet does: stages of a head in their order, fields beside each other, the
head that came first first. A preempted task loses what it did since its last checkpoint, or since it began where the stage
keeps none, and is queued again. Says how long all of it takes, how busy the slots were, how late the last heads were, and
what preemption cost with checkpoints and without.
"""

import argparse
import heapq
import json
import random
import sys

NEEDS = {
    "mask": [],
    "baseline": ["mask"],
    "tface": ["mask"],
    "iface": ["mask"],
    "mesh": ["iface"],
    "render": ["baseline", "tface", "iface", "mesh"],
    "ensemble": ["render"],
    "metrics": ["render", "ensemble"],
}
LEARNS = ("baseline", "tface", "iface")


def simulate(heads, slots, preempt_per_hour, checkpoint_s, overhead_s, seed):
    """Returns seconds to the end, seconds of slots that were worked, of those lost, and each head's end; None if it would
    not come to one."""
    chance = random.Random(seed)
    left = {(h, stage): seconds for h, head in enumerate(heads) for stage, seconds in head.items()}
    waiting = [(h, list(NEEDS).index(s), s) for (h, s) in left if not [n for n in NEEDS[s] if n in heads[h]]]
    heapq.heapify(waiting)
    running, now, worked, lost, ends = [], 0.0, 0.0, 0.0, {}
    done = set()
    while waiting or running:
        while waiting and len(running) < slots:
            h, order, stage = heapq.heappop(waiting)
            need = left[h, stage] + overhead_s
            until = chance.expovariate(preempt_per_hour / 3600) if preempt_per_hour else float("inf")
            heapq.heappush(running, (now + min(need, until), h, order, stage, need, until))
        now, h, order, stage, need, until = heapq.heappop(running)
        if until < need:
            did = max(0.0, until - overhead_s)
            every = checkpoint_s if checkpoint_s and stage in LEARNS else 0
            kept = did - did % every if every else 0.0
            if not kept and need > 4 * 3600 / preempt_per_hour:
                return None  # so long without a checkpoint comes through once in fifty times: never, for a thousand
            left[h, stage] -= kept
            worked += until
            lost += until - kept
            heapq.heappush(waiting, (h, order, stage))
            continue
        worked += need
        done.add((h, stage))
        if all((h, s) in done for s in heads[h]):
            ends[h] = now
        for after, needs in NEEDS.items():
            if after in heads[h] and stage in needs and all((h, n) in done for n in needs if n in heads[h]):
                heapq.heappush(waiting, (h, list(NEEDS).index(after), after))
    return now, worked, lost, ends


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--heads", type=int, default=1000)
    options.add_argument("--slots", type=int, default=8, help="tasks at once")
    options.add_argument("--preempt", type=float, default=0, help="times per hour that a slot is taken away")
    options.add_argument("--checkpoint", type=float, default=60, help="seconds between checkpoints of a training")
    options.add_argument("--overhead", type=float, default=1.5, help="seconds of the engine and of opening a capture, a task")
    options.add_argument("--spread", type=float, default=0.2, help="standard deviation of the logarithm of a head's size")
    options.add_argument("--seed", type=int, default=1)
    options = options.parse_args()
    measured = []
    for line in sys.stdin:
        run = json.loads(line)
        if run.get("state") == "done":
            measured.append({s["stage"]: s["elapsed_s"] for s in run["stages"] if s["state"] == "done"})
    assert measured, "no run of these is done"
    chance = random.Random(options.seed)
    heads = []
    for _ in range(options.heads):
        factor = chance.lognormvariate(0, options.spread)
        heads.append({stage: s * factor for stage, s in chance.choice(measured).items()})
    work = sum(sum(head.values()) for head in heads)
    print(f"{options.heads} heads of {work / options.heads / 60:.1f} min, {options.slots} at once, from {len(measured)} measured")
    cases = [("undisturbed", 0, options.checkpoint)]
    if options.preempt:
        cases += [("preempted, checkpoints", options.preempt, options.checkpoint), ("preempted, none", options.preempt, 0)]
    print("| case | hours | slots busy | of it lost | half of the heads after | the last tenth took |\n|---|---|---|---|---|---|")
    for name, preempt, checkpoint in cases:
        found = simulate(heads, options.slots, preempt, checkpoint, options.overhead, options.seed)
        if found is None:
            print(f"| {name} | never: the longest stages last longer than slots do | | | | |")
            continue
        end, worked, lost, ends = found
        times = sorted(ends.values())
        busy, wasted = worked / (end * options.slots), lost / worked
        last = end - times[int(0.9 * len(times))]
        print(f"| {name} | {end / 3600:.2f} | {busy:.1%} | {wasted:.1%} | {times[len(times) // 2] / 3600:.2f} h | {last / 3600:.2f} h |")


main()
