"use strict";
const D = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

/** Make an element. Texts are set as text, so that no name can be taken for HTML. */
function make(tag, properties = {}, ...children) {
  const element = tag.startsWith("svg:") ? document.createElementNS(SVG, tag.slice(4)) : document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name === "text") element.textContent = value;
    else if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child));
  return element;
}
const percent = (share) => `${Math.round(100 * share)}\u00a0%`;
const short = (number) => String(Number(Number(number).toPrecision(3))).replace("-", "\u2212");

function label(name, action) {
  const space = D.spaces[name];
  if (space.kind === "number") return action.map(short).join(", ");
  if (space.kind === "binary") return space.labels[0].filter((_, k) => action[k]).join(" + ") || "none";
  return action.map((index, part) => space.labels[part][index]).join(" / ");
}

/** One group of bars for each part of an action space: how likely each action is, and which was done. */
function bars(name, numbers, did, kind) {
  const space = D.spaces[name], box = make("div");
  if (space.kind === "number") return numberBars(space, numbers, did);
  let start = 0;
  space.labels.forEach((labels, part) => {
    const values = numbers.slice(start, start + labels.length);
    start += labels.length;
    const low = kind === "values" ? Math.min(...values) : 0;
    const size = kind === "values" ? Math.max(...values) - low || 1 : 1;
    const most = values.indexOf(Math.max(...values));
    const done = (k) => did && (space.kind === "binary" ? did[k] === 1 : did[part] === k);
    const top = (k) => (space.kind === "binary" ? values[k] > 0.5 : k === most);
    let shown = labels.map((_, k) => k);
    if (shown.length > 8) shown = shown.sort((a, b) => values[b] - values[a]).filter((k, rank) => rank < 6 || done(k)).sort((a, b) => a - b);
    if (space.labels.length > 1) box.append(make("div", { class: "part", text: `part ${part}` }));
    const group = make("div", { class: "bars" });
    for (const k of shown) {
      const text = kind === "values" ? short(values[k]) : percent(values[k]);
      const mark = done(k) ? "◆ " : "";
      group.append(make("div", { class: `bar${top(k) ? " top" : ""}${done(k) ? " did" : ""}`, title: `${labels[k]}: ${text}${done(k) ? ", and so it did" : ""}` },
        make("span", { text: mark + labels[k] }),
        make("i", {}, make("b", { style: `width:${Math.max(0, Math.min(1, (values[k] - low) / size)) * 100}%` })),
        make("span", { text })));
    }
    if (shown.length < labels.length) group.append(make("div", { class: "part", text: `and ${labels.length - shown.length} less likely actions` }));
    box.append(group);
  });
  return box;
}

/** A scale for each number of a continuous action: the bar is what was done, the square what was expected. */
function numberBars(space, numbers, did) {
  const group = make("div", { class: "bars" });
  space.low.slice(0, 8).forEach((low, k) => {
    const values = [numbers[k], did && did[k]].filter((value) => value !== undefined && value !== null);
    const least = Math.min(low, ...values), most = Math.max(space.high[k], ...values);
    const at = (value) => `left:${(100 * (value - least)) / (most - least || 1)}%`;
    const expected = numbers[k] === undefined ? null : make("s", { style: at(numbers[k]) });
    group.append(make("div", { class: "bar", title: values.map(short).join(", did ") },
      make("span", { text: `number ${k}` }),
      make("i", {}, did ? make("u", { style: at(did[k]) }) : null, expected),
      make("span", { text: short(values[0]) })));
  });
  return group;
}
