// @ts-check
// Places of labels: each at the first of its spots that is free; those of low priority are dropped.

/** @typedef {{x: number, y: number, wide: number, high: number}} Box */

/** True if two boxes are nearer to each other than a gap. @param {Box} a @param {Box} b @param {number} [gap] */
export const meet = (a, b, gap = 0) => a.x < b.x + b.wide + gap && b.x < a.x + a.wide + gap
  && a.y < b.y + b.high + gap && b.y < a.y + a.high + gap;

/** A free box for each label, or null if all its spots are taken. Earlier labels have priority.
 * @param {Box[][]} labels boxes of each label, the best first
 * @param {Box[]} taken boxes that no label may touch; the boxes of the labels are added
 * @param {number} [gap] @returns {(Box | null)[]} */
export function placed(labels, taken, gap = 2) {
  return labels.map((spots) => {
    const free = spots.find((spot) => !taken.some((one) => meet(spot, one, gap))) || null;
    if (free) taken.push(free);
    return free;
  });
}
