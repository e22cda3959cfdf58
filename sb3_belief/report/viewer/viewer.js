const MANY = 4; // more others than this: those that are not seen are folded
const all = (flags) => flags.every(Boolean);
// Not the keys of an object, which are sorted where they are numbers
const names = D.names.filter((name) => Object.hasOwn(D.agents, name));
// The first step of each episode, counted over all of them
const offsets = D.episodes.map((_, e) => D.episodes.slice(0, e).reduce((sum, episode) => sum + episode.steps.length, 0));
const images = D.frames.map((url) => { const image = new Image(); image.src = url; return image; });
const now = { episode: 0, step: 0, agent: names[0] };
let timer = null;

const steps = () => D.episodes[now.episode].steps;
const view = (step = now.step) => steps()[step].views[now.agent];
const agent = () => D.agents[now.agent];
/** 1 right, 0 wrong, null where it cannot be said: not seen, or no action that is right or wrong. */
const verdict = (seen, k) => (seen.right && seen.right[k] ? (all(seen.right[k]) ? 1 : 0) : null);
const WORDS = { 1: ["right", "✓ right"], 0: ["wrong", "✗ wrong"] };

// The picture

function drawFrame() {
  const step = steps()[now.step], image = $("frame");
  image.src = D.frames[step.frame];
  image.alt = `The environment at step ${now.step}`;
  const svg = $("overlay"), shown = images[step.frame];
  svg.replaceChildren();
  if (!shown.naturalWidth) { shown.addEventListener("load", draw, { once: true }); return; }
  const height = (100 * shown.naturalHeight) / shown.naturalWidth;
  $("figure").style.setProperty("--ratio", 100 / height);
  svg.setAttribute("viewBox", `0 0 100 ${height}`);
  const at = (name) => step.at[name] && [100 * step.at[name][0], height * step.at[name][1]], me = at(now.agent);
  const seen = view(), r = radius(height);
  const circle = (place, size, kind) => make("svg:circle", { cx: place[0], cy: place[1], r: size, class: kind });
  agent().others.forEach((other, k) => {
    const place = at(other);
    if (!place || !me || !seen.sees[k] || !seen.active) return;
    const how = verdict(seen, k), kind = how === null ? "none" : WORDS[how][0];
    // From ring to ring, where there is room between them
    const apart = Math.hypot(place[0] - me[0], place[1] - me[1]), along = (d) => [0, 1].map((i) => me[i] + ((place[i] - me[i]) * d) / apart);
    const [[x1, y1], [x2, y2]] = [along(1.2 * r), along(apart - r)];
    if (apart > 2.4 * r) svg.append(...["sight under", "sight"].map((kind) => make("svg:line", { x1, y1, x2, y2, class: kind })));
    svg.append(circle(place, r, "ring under"), circle(place, r, `ring line-${kind}`));
    if (how !== null) {
      const corner = [Math.min(place[0] + 0.75 * r, 97), Math.max(place[1] - 0.75 * r, 3)];
      svg.append(circle(corner, 2.1, `badge fill-${kind}`));
      svg.append(make("svg:text", { x: corner[0], y: corner[1], "font-size": 2.9, text: how ? "✓" : "✗" }));
    }
  });
  if (me) svg.append(circle(me, r * 1.15, "chosen"), circle(me, r * 1.15, "chosen inner"));
  for (const name of names) {
    const place = at(name);
    if (!place) continue;
    const k = agent().others.indexOf(name);
    if (names.length <= 6 || k < 0 || seen.sees[k]) {
      // Below it or above, where it is farther from the others
      const others = Object.keys(step.at).filter((other) => other !== name).map(at);
      const room = (y) => Math.min(y - 1.5, height - 1.5 - y, ...others.map((other) => Math.hypot(other[0] - place[0], other[1] - y)));
      const y = [place[1] + r + 2.4, place[1] - r - 2.4].sort((a, b) => room(b) - room(a))[0];
      const half = 0.9 * name.length + 1; // of the text's width, nearly
      svg.append(make("svg:text", { x: Math.max(half, Math.min(100 - half, place[0])), y, class: `name${k < 0 ? " me" : ""}`, text: name }));
    }
    const target = make("svg:circle", { cx: place[0], cy: place[1], r: r * 1.2, class: "who", onclick: () => choose(name) });
    target.append(make("svg:title", { text: name }));
    svg.append(target);
  }
}

let radiusKept = null;
/** Radius of the rings: half of the least distance of two different places, which is half a cell of a grid. */
function radius(height) {
  if (radiusKept === null) {
    const places = [...new Set(D.episodes.flatMap((e) => e.steps.flatMap((s) => Object.values(s.at).map((p) => p.join()))))].slice(0, 400);
    const points = places.map((text) => text.split(",").map(Number));
    let least = Infinity;
    points.forEach((p, i) => points.slice(i + 1).forEach((q) => {
      const distance = Math.hypot(100 * (p[0] - q[0]), height * (p[1] - q[1]));
      if (distance > 0.5) least = Math.min(least, distance);
    }));
    radiusKept = Math.max(3.2, Math.min(7, 0.52 * least));
  }
  return radiusKept;
}

// Time

/** The tracks: the team's reward, and of each other whether the agent was right. */
function buildTimeline() {
  const box = $("timeline"), n = steps().length;
  const track = (name, title, cells) => make("div", { class: "track", "data-name": name, title },
    make("span", { text: name }), make("svg:svg", { viewBox: `0 0 ${n} 1`, preserveAspectRatio: "none", "aria-hidden": "true" }, ...cells));
  const cell = (t, height, kind, y = 1 - height) => make("svg:rect", { x: t + 0.06, y, width: 0.88, height, class: kind });
  const rewards = steps().map((step) => step.reward), low = Math.min(0, ...rewards);
  const size = Math.max(0, ...rewards) - low || 1, zero = 1 + low / size;
  const tracks = [track("reward", "The team's reward at each step", rewards.map((reward, t) =>
    cell(t, Math.max(Math.abs(reward) / size, 0.03), "amount", reward > 0 ? zero - reward / size : Math.min(zero, 0.97))))];
  if (agent().belief) {
    const errors = steps().flatMap((_, t) => view(t).error).filter((error) => error !== null);
    const worst = Math.max(...errors, 1e-9);
    agent().others.forEach((other, k) => {
      const cells = [];
      let right = 0, total = 0;
      steps().forEach((_, t) => {
        const seen = view(t), how = verdict(seen, k);
        // Height tells right from wrong too
        if (how !== null) { total += 1; right += how; cells.push(cell(t, how ? 0.5 : 1, WORDS[how][0])); }
        else if (seen.active && seen.sees[k] && seen.error[k] !== null) cells.push(cell(t, Math.max(seen.error[k] / worst, 0.06), "amount"));
        else cells.push(cell(t, 0.07, "blank"));
      });
      if (agent().others.length > MANY && !steps().some((_, t) => view(t).sees[k])) return;
      tracks.push(track(other, total ? `${other}: right at ${right} of ${total} steps` : other, cells));
    });
  }
  box.className = tracks.length > 9 ? "many" : "";
  $("figure").style.setProperty("--tracks", tracks.length * (tracks.length > 9 ? 0.7 : 1));
  box.replaceChildren(...tracks, make("div", { id: "head" }));
  box.setAttribute("aria-valuemax", n - 1);
}

function placeHead() {
  $("head").style.setProperty("--from", now.step / steps().length);
  $("head").style.setProperty("--share", 1 / steps().length);
  $("timeline").setAttribute("aria-valuenow", now.step);
  $("timeline").setAttribute("aria-valuetext", `step ${now.step} of ${steps().length}`);
}

function stepAt(event) {
  const lane = $("timeline").querySelector("svg").getBoundingClientRect();
  return Math.floor((steps().length * (event.clientX - lane.left)) / lane.width);
}

// The panels

function drawAgents() {
  const step = steps()[now.step];
  const focused = document.activeElement?.dataset.agent;
  $("agents").replaceChildren(...names.map((name) => make("button", {
    type: "button", role: "radio", "aria-checked": String(name === now.agent), "data-agent": name, text: name,
    class: step.views[name].active ? "" : "idle", title: `${name} (${D.agents[name].algorithm})${step.views[name].active ? "" : ", not in play"}`,
    onclick: () => choose(name),
  })));
  if (focused) [...$("agents").children].find((button) => button.dataset.agent === focused)?.focus();
}

function drawOwn() {
  const seen = view(), did = steps()[now.step].did[now.agent], own = seen.own;
  $("own-title").textContent = `What ${now.agent} would do, and does: ${label(now.agent, did)}`;
  const facts = make("p", { id: "own-facts", class: "quiet" },
    make("span", { text: `reward ${short(seen.reward)}` }),
    seen.value === null ? null : make("span", { text: `its value of this state ${short(seen.value)}` }),
    make("span", { text: agent().algorithm }));
  const box = own.kind ? bars(now.agent, own.numbers, did, own.kind) : make("p", { class: "quiet", text: "Its policy gives no probabilities." });
  $("own").replaceChildren(...[own.kind === "values" ? make("p", { class: "quiet", text: "Values of its actions:" }) : null, box, facts].filter(Boolean));
}

function drawOthers() {
  const seen = view(), step = steps()[now.step], believes = Boolean(agent().belief);
  $("others-title").textContent = believes ? `What ${now.agent} believes that the others will do` : `What the others do`;
  const folded = [], absent = [];
  const cards = agent().others.map((other, k) => {
    const sees = seen.sees[k] && seen.active, how = believes ? verdict(seen, k) : null;
    if (!sees && step.views[other] && !step.views[other].active) { absent.push(other); return null; }
    if (!sees && agent().others.length > MANY) { folded.push(other); return null; }
    const word = !sees ? "not seen" : how === null ? "seen" : WORDS[how][1];
    const kind = how === null ? "" : WORDS[how][0], did = `${sees ? "did" : "does, unseen:"} ${label(other, step.did[other])}`;
    const error = believes && seen.error[k] !== null ? `, off by ${short(seen.error[k])}` : "";
    return make("article", { class: `card ${kind}${sees ? "" : " dim"}`, "data-other": other, "aria-label": `${other}: ${word}` },
      make("h3", {}, make("span", { text: other }), make("span", { class: `tag ${kind}`, text: word })),
      believes ? bars(other, seen.expects[k], step.did[other]) : null,
      make("div", { class: "quiet", text: `◆ ${did}${error}` }));
  }).filter(Boolean);
  $("others").replaceChildren(...cards);
  const lists = [["Not seen", folded], ["Not in play", absent]].filter(([, others]) => others.length);
  $("unseen").textContent = lists.map(([what, others]) => `${what}: ${others.join(", ")}`).join(" · ");
}

function drawScore() {
  const counts = (until) => {
    let right = 0, total = 0;
    const done = new Map();
    for (let t = 0; t < until; t += 1) {
      (view(t).right || []).forEach((parts, k) => (parts || []).forEach((flag, part) => {
        right += flag; total += 1;
        const key = `${k} ${part}`, action = steps()[t].did[agent().others[k]][part];
        if (!done.has(key)) done.set(key, new Map());
        done.get(key).set(action, (done.get(key).get(action) || 0) + 1);
      }));
    }
    const frequent = [...done.values()].reduce((sum, actions) => sum + Math.max(...actions.values()), 0);
    return { right, total, frequent };
  };
  const so = counts(now.step + 1), whole = counts(steps().length);
  const parts = [];
  if (!agent().belief) parts.push(`${now.agent} has no belief about the others.`);
  else if (whole.total) {
    parts.push(make("strong", { text: so.total ? percent(so.right / so.total) : "–" }), ` right so far (${so.right} of ${so.total}); whole episode ${percent(whole.right / whole.total)}, `);
    parts.push(`always naming each other's most frequent action ${percent(whole.frequent / whole.total)}`);
  }
  $("score").replaceChildren(...parts);
}

function drawMemory() {
  const seen = view(), cards = agent().cards;
  $("memory-panel").hidden = !agent().belief;
  const rows = cards ? seen.rows : [], most = rows.length ? rows[0][1] : 1;
  $("memory-note").textContent = cards
    ? `${rows.length} of the last ${agent().history} steps in which it was in play, the newest on the right; the higher, the more weight.`
    : "This belief has no history, or an empty one: it follows from the observation alone.";
  $("rows").replaceChildren(...(cards ? [make("svg:svg", { viewBox: `0 0 ${agent().history} 1`, preserveAspectRatio: "none", role: "img", "aria-label": `Weights of ${rows.length} history rows` },
    ...rows.map(([row, weight]) => make("svg:rect", { x: row, width: Math.max(agent().history / 250, 1), y: 1 - weight / most, height: weight / most })))] : []));
  const shown = rows.filter(([row]) => cards[row]).slice(0, 6);
  const rest = rows.slice(shown.length).reduce((sum, [, weight]) => sum + weight, 0);
  $("memory").replaceChildren(...shown.map(([row, weight]) => memoryCard(row, weight, cards[row], weight / most)));
  if (rows.length > shown.length) $("memory").append(make("p", { class: "quiet sum", text: `The other ${rows.length - shown.length} rows together: ${percent(rest)} of the weight.` }));
}

function memoryCard(row, weight, card, share) {
  const [like, same] = card.like;
  const episode = offsets.findLastIndex((start) => start <= like), step = like - offsets[episode];
  const chips = agent().others.map((other, k) => card.did[k] && make("span", { class: "chip", text: `${other}: ${label(other, card.did[k])}` })).filter(Boolean);
  const place = `step ${step}${D.episodes.length > 1 ? ` of episode ${episode + 1}` : ""}`;
  const canvas = make("canvas", { width: 96, height: 2, role: "img", "aria-label": "Observation now (above) and then (below)", title: "Its observation now (above) and then (below)" });
  drawStrip(canvas, agent().now[offsets[now.episode] + now.step], card.seen);
  return make("article", { class: "card", "data-row": row },
    make("h3", {}, make("span", { text: `${card.age} ${card.age === 1 ? "step" : "steps"} back` }), make("span", { class: "tag", text: `${(100 * weight).toFixed(1)} %` })),
    make("div", { class: "weight" }, make("b", { style: `width:${100 * share}%` })),
    make("div", { class: "chips" }, ...(chips.length ? chips : [make("span", { class: "quiet", text: "it saw nobody act" })])),
    make("div", { class: "strip" }, make("span", { text: "now" }), canvas, make("span", { text: "then" })),
    make("button", { type: "button", class: "jump", onclick: () => go(step, episode), text: "" },
      same ? `same observation and actions as at ${place}` : `observation most like ${place}`,
      same ? make("img", { src: D.frames[D.episodes[episode].steps[step].frame], alt: `The environment at ${place}` }) : null));
}

function drawStrip(canvas, above, below) {
  const rows = [above, below].map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  canvas.width = Math.max(rows[0].length, 1);
  const context = canvas.getContext("2d");
  rows.forEach((row, y) => row.forEach((level, x) => {
    context.fillStyle = `hsl(216 55% ${92 - (66 * level) / 255}%)`;
    context.fillRect(x, y, 1, 1);
  }));
}

function draw() {
  const step = steps()[now.step];
  drawFrame();
  drawAgents();
  $("step").textContent = `step ${now.step} of ${steps().length}`;
  $("status").textContent = view().active ? "" : `${now.agent} is not in play at this step.`;
  for (const id of ["own-panel", "others-panel"]) $(id).style.opacity = view().active ? 1 : 0.5;
  document.querySelectorAll(".track").forEach((track) => {
    const k = agent().others.indexOf(track.dataset.name);
    track.classList.toggle("seen", k >= 0 && step.views[now.agent].sees[k] && step.views[now.agent].active);
  });
  drawOwn(); drawOthers(); drawScore(); drawMemory(); placeHead();
  try { history.replaceState(null, "", `#episode=${now.episode + 1}&step=${now.step}&agent=${encodeURIComponent(now.agent)}`); } catch { /* not everywhere */ }
}

// What the user does

function go(step, episode = now.episode) {
  const moved = episode !== now.episode;
  now.episode = episode;
  now.step = Math.max(0, Math.min(steps().length - 1, step));
  if (moved) { $("episode").value = episode; drawOutcome(); buildTimeline(); }
  draw();
}
function choose(name) { now.agent = name; buildTimeline(); draw(); }
function pause() { clearInterval(timer); timer = null; showPlaying(); }
function play() {
  if (now.step === steps().length - 1) go(0);
  timer = setInterval(() => (now.step < steps().length - 1 ? go(now.step + 1) : pause()), 1000 / Number($("speed").value));
  showPlaying();
}
function showPlaying() {
  $("play").querySelector("path").setAttribute("d", timer ? "M4 3h4v14H4zM12 3h4v14h-4z" : "M5 3l12 7-12 7z");
  $("play").setAttribute("aria-label", timer ? "Pause" : "Play");
}
function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  $("theme").textContent = theme === "dark" ? "☀\uFE0E light" : "☾\uFE0E dark";
}
function drawOutcome() {
  const episode = D.episodes[now.episode], success = episode.success === null ? null : make("span", { class: `tag ${episode.success ? "right" : "wrong"}`, text: episode.success ? "✓ success" : "✗ no success" });
  $("outcome").replaceChildren(...[make("span", { class: "tag", text: `return ${short(episode.return)}` }), make("span", { class: "tag", text: `${steps().length} steps` }), success].filter(Boolean));
}

/** The step at which the page opens: where the agent sees most others. */
function bestStep(name) {
  const counts = steps().map((step) => (step.views[name].active ? step.views[name].sees.filter(Boolean).length : -1));
  return counts.indexOf(Math.max(...counts));
}

function start() {
  for (const id of ["title", "subtitle"]) $(id).textContent = D[id];
  $("episode").append(...D.episodes.map((_, e) => make("option", { value: e, text: `episode ${e + 1}` })));
  $("episode").hidden = D.episodes.length < 2;
  const asked = new URLSearchParams(location.hash.slice(1));
  const number = (name, most) => Math.max(0, Math.min(most, Math.trunc(Number(asked.get(name))) || 0));
  now.episode = Math.max(number("episode", D.episodes.length), 1) - 1;
  now.agent = names.includes(asked.get("agent")) ? asked.get("agent") : D.agent;
  now.step = asked.has("step") ? number("step", steps().length - 1) : bestStep(now.agent);
  $("episode").value = now.episode;
  $("legend").replaceChildren(make("b", { class: "r", text: "✓ low" }), ": it did what was most likely. ", make("b", { class: "w", text: "✗ high" }), ": it did something else. Empty: not seen.");
  $("first").onclick = () => go(0); $("last").onclick = () => go(steps().length - 1);
  $("back").onclick = () => go(now.step - 1); $("forward").onclick = () => go(now.step + 1);
  $("play").onclick = () => (timer ? pause() : play());
  $("speed").onchange = () => { if (timer) { clearInterval(timer); play(); } };
  $("episode").onchange = (event) => { pause(); go(0, Number(event.target.value)); };
  $("theme").onclick = () => setTheme(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  $("timeline").onpointerdown = (event) => { $("timeline").setPointerCapture(event.pointerId); go(stepAt(event)); };
  $("timeline").onpointermove = (event) => { if (event.buttons) go(stepAt(event)); };
  // Paper is light
  let before = null;
  window.addEventListener("beforeprint", () => { before = document.documentElement.dataset.theme; setTheme("light"); });
  window.addEventListener("afterprint", () => setTheme(before));
  document.addEventListener("keydown", (event) => {
    if (event.target.tagName === "SELECT" || event.ctrlKey || event.metaKey || event.altKey) return;
    const turn = (by) => choose(names[(names.indexOf(now.agent) + by + names.length) % names.length]);
    const keys = {
      " ": () => (timer ? pause() : play()), ArrowRight: () => go(now.step + 1), ArrowLeft: () => go(now.step - 1), Home: () => go(0),
      End: () => go(steps().length - 1), ArrowUp: () => turn(-1), ArrowDown: () => turn(1), t: () => $("theme").click(),
    };
    if (!keys[event.key] || (event.key === " " && event.target.tagName === "BUTTON" && event.target.id !== "play")) return;
    event.preventDefault();
    keys[event.key]();
  });
  setTheme(window.matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  drawOutcome(); buildTimeline(); showPlaying(); draw();
}
start();
