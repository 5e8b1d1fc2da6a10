"use strict";
// Tables: a click on a heading sorts by it, numbers as numbers, empty cells last; a second click turns the order.
const amount = (text) => {
  const found = /^[<>~]*(-?(?:\d+\.?\d*(?:e[+-]?\d+)?|inf))/.exec(text);
  return found ? (found[1] === "inf" ? Infinity : Number(found[1])) : null;
};
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const body = table.tBodies[0];
      const rows = [...body.rows].map((row) => ({ row, text: row.cells[column].textContent }));
      const numeric = rows.every(({ text }) => text === "-" || amount(text) !== null);
      rows.sort((a, b) => {
        if ((a.text === "-") !== (b.text === "-")) return a.text === "-" ? 1 : -1;
        const order = numeric ? amount(a.text) - amount(b.text) : a.text.localeCompare(b.text);
        return (Number.isNaN(order) ? 0 : order) * (down ? -1 : 1);
      });
      body.append(...rows.map(({ row }) => row));
    });
  });
}

// Images: two of them in one place, divided by a line.
const images = JSON.parse(document.getElementById("images").textContent);
const byId = (id) => document.getElementById(id);
const [choice, left, right, split, stage] = ["case", "left", "right", "split", "stage"].map(byId);
const fill = (select, names, wanted) => {
  select.replaceChildren(...names.map((name) => new Option(name, name)));
  if (names.includes(wanted)) select.value = wanted;
};
const show = () => {
  const set = images[choice.value];
  byId("above").src = set[left.value];
  byId("below").src = set[right.value];
  byId("above").alt = byId("tag-left").textContent = left.value;
  byId("below").alt = byId("tag-right").textContent = right.value;
  divide();
};
const divide = () => {
  const share = split.value / 10;
  byId("above").style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  byId("line").style.left = `${share}%`;
};
const resize = () => {
  for (const image of [byId("above"), byId("below")]) {
    image.style.width = image.naturalWidth ? `${image.naturalWidth * (byId("zoom").checked ? 2 : 1)}px` : "";
    image.style.imageRendering = byId("zoom").checked ? "pixelated" : "";
  }
};
const choose = () => {
  const names = Object.keys(images[choice.value]);
  const first = (test) => names.find(test) ?? names[0];
  const before = [left.value, right.value];
  fill(left, names, names.includes(before[0]) ? before[0] : first((name) => name.startsWith("layered")));
  fill(right, names, names.includes(before[1]) ? before[1] : first((name) => name === "reference, gaussian lens"));
  show();
};
if (Object.keys(images).length) {
  byId("compare").hidden = false;
  fill(choice, Object.keys(images));
  choice.addEventListener("change", choose);
  left.addEventListener("change", show);
  right.addEventListener("change", show);
  split.addEventListener("input", divide);
  byId("zoom").addEventListener("change", resize);
  byId("below").addEventListener("load", resize);
  byId("above").addEventListener("load", resize);
  // Small images start enlarged.
  byId("below").addEventListener("load", () => {
    byId("zoom").checked = byId("below").naturalWidth <= 384;
    resize();
  }, { once: true });
  const drag = (event) => {
    if (event.buttons !== 1) return;
    const box = byId("below").getBoundingClientRect();
    split.value = Math.round((1000 * (event.clientX - box.left)) / box.width);
    divide();
    event.preventDefault();
  };
  stage.addEventListener("pointerdown", drag);
  stage.addEventListener("pointermove", drag);
  choose();
}
