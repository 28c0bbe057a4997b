// The expected information of another grasp, as computed by the service.

import { h } from "./dom.js";

const MIN_SHOWN_BITS = 0.005;

export function nextGraspSection({ posterior, information }) {
  const { next_grasp_bits: bits, remaining_bits: remaining, next_effective_grasps: effective } = information;
  const expected =
    bits < MIN_SHOWN_BITS
      ? "Another grasp would add almost no information"
      : `Another grasp would add about ${bits.toFixed(2)} of the ${remaining.toFixed(1)} remaining bits of uncertainty`;
  return h(
    "section",
    { class: "next-grasp", "aria-label": "Another grasp" },
    h("h3", {}, "Another grasp?"),
    h(
      "p",
      { class: "summary-line" },
      `${expected}: for this model, ${posterior.grasps + 1} grasps of one object count as ${effective.toFixed(2)} independent ones.`,
    ),
    h(
      "p",
      { class: "muted" },
      "Grasp at another height than before. The matcher cannot name a better place: " +
        "places chosen by the photo were no better than random ones.",
    ),
  );
}
