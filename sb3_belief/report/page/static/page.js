"use strict";
(() => {
  const root = document.documentElement;
  const all = (selector, within = document) => [...within.querySelectorAll(selector)];

  // ---- light and dark ------------------------------------------------------------------------------------------
  const button = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const isDark = () => (root.dataset.theme ? root.dataset.theme === "dark" : system.matches);
  const name = () => { button.textContent = isDark() ? "Light" : "Dark"; };
  button.addEventListener("click", () => {
    root.dataset.theme = isDark() ? "light" : "dark";
    // A browser may forbid a page from a file to remember anything
    try { localStorage.setItem("sb3-belief-theme", root.dataset.theme); } catch (error) { /* then it is not remembered */ }
    name();
  });
  system.addEventListener("change", name);
  name();
  document.getElementById("print")?.addEventListener("click", () => print());

  // ---- texts to copy -------------------------------------------------------------------------------------------
  for (const copy of all("[data-copies]")) {
    const words = copy.textContent;
    copy.addEventListener("click", async () => {
      const source = document.getElementById(copy.dataset.copies);
      try {
        await navigator.clipboard.writeText(source.textContent);
        copy.textContent = "Copied";
      } catch (error) {
        getSelection().selectAllChildren(source);
        copy.textContent = "Selected: copy it with Ctrl-C";
      }
      setTimeout(() => { copy.textContent = words; }, 2500);
    });
  }

  // ---- tables --------------------------------------------------------------------------------------------------
  const collator = new Intl.Collator(undefined, { numeric: true });
  const keyOf = (row, index) => row.cells[index].dataset.key ?? null;
  function compare(a, b, numeric) {
    // Cells without a value stand last, whichever way the table is sorted
    if (a === null || b === null) return 0;
    return numeric ? a - b : collator.compare(a, b);
  }
  function sort(table, index, direction) {
    const heads = [...table.tHead.rows[0].cells];
    const numeric = heads[index].dataset.numeric !== undefined;
    const rows = [...table.tBodies[0].rows];
    rows.sort((one, other) => {
      const a = keyOf(one, index), b = keyOf(other, index);
      if ((a === null) !== (b === null)) return a === null ? 1 : -1;
      return direction * compare(a, b, numeric) || one.dataset.index - other.dataset.index;
    });
    table.tBodies[0].append(...rows);
    heads.forEach((head, i) => head.setAttribute("aria-sort", i !== index ? "none" : direction > 0 ? "ascending" : "descending"));
  }
  for (const box of all(".table")) {
    const table = box.querySelector("table"), rows = [...table.tBodies[0].rows];
    rows.forEach((row, index) => { row.dataset.index = index; });
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, index) => head.querySelector("button")?.addEventListener("click", () => {
      sort(table, index, head.getAttribute("aria-sort") === "ascending" ? -1 : 1);
    }));
    const choice = box.querySelector(".sorting select");
    choice?.addEventListener("change", () => {
      const [index, direction] = choice.value.split(" ").map(Number);
      sort(table, index, direction);
    });
    const input = box.querySelector("input"), count = box.querySelector(".count");
    input?.addEventListener("input", () => {
      const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        const text = row.textContent.toLowerCase();
        row.hidden = !words.every((word) => text.includes(word));
        shown += !row.hidden;
      }
      count.textContent = words.length ? `${shown} of ${rows.length} rows` : `${rows.length} rows`;
    });
  }

  // ---- figures -------------------------------------------------------------------------------------------------
  const holder = document.getElementById("figures");
  const specs = holder ? JSON.parse(holder.textContent) : {};
  const views = new Map();
  let hidden = [];
  async function draw(place) {
    const spec = specs[place.dataset.figure];
    if (!spec || views.has(place) || !window.vegaEmbed) return;
    views.set(place, null);
    const height = place.getBoundingClientRect().height;
    place.style.minHeight = `${height}px`;
    const fresh = document.createElement("div");
    fresh.className = "drawing";
    fresh.style.cssText = `position:absolute;visibility:hidden;width:${place.clientWidth}px`;
    place.after(fresh);
    try {
      const options = { actions: false, renderer: "svg", tooltip: { disableDefaultStyle: false } };
      const result = await vegaEmbed(fresh, spec, options);
      await result.view.signal("hidden", hidden).runAsync();
      fresh.style.cssText = "";
      place.hidden = true;
      views.set(place, result.view);
      // Until here the place held a picture of the same figure
      place.remove();
      fresh.dataset.drawn = place.dataset.figure;
    } catch (error) {
      console.error(error);
      fresh.remove();
    }
  }
  const places = all(".drawing[data-figure]");
  if (window.vegaEmbed && places.length) {
    const queue = [];
    let busy = false;
    const next = async () => {
      if (busy) return;
      busy = true;
      while (queue.length) {
        await draw(queue.shift());
        await new Promise((resolve) => setTimeout(resolve));
      }
      busy = false;
    };
    const observer = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        if (entry.isIntersecting) {
          observer.unobserve(entry.target);
          queue.push(entry.target);
        }
      }
      next();
    }, { rootMargin: "300px" });
    places.forEach((place) => observer.observe(place));
  }
  for (const toggle of all(".legend button")) {
    toggle.addEventListener("click", () => {
      const arm = toggle.dataset.arm, off = !hidden.includes(arm);
      hidden = off ? [...hidden, arm] : hidden.filter((each) => each !== arm);
      for (const each of all(".legend button")) {
        if (each.dataset.arm === arm) each.setAttribute("aria-pressed", String(!off));
      }
      // Figures that are not drawn yet get it when they are
      for (const view of views.values()) view?.signal("hidden", hidden).runAsync();
    });
  }

  // ---- the menu says where one is ------------------------------------------------------------------------------
  const links = all(".bar nav a[href^='#']");
  const sections = links.map((link) => document.getElementById(link.hash.slice(1))).filter(Boolean);
  const mark = () => {
    const top = sections.filter((section) => section.getBoundingClientRect().top < 140).pop();
    for (const link of links) {
      if (top && link.hash === `#${top.id}`) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  };
  addEventListener("scroll", mark, { passive: true });
  mark();
})();
