// The countdown of a season. The page states both times without it.
"use strict";

const UNITS = [["day", 86400], ["hour", 3600], ["minute", 60]];

function lasting(seconds) {
  const [name, size] = UNITS.find(([, size]) => seconds >= size) || UNITS.at(-1);
  const count = Math.max(1, Math.floor(seconds / size));
  return `${count} ${name}${count === 1 ? "" : "s"}`;
}

for (const element of document.querySelectorAll("[data-opens]")) {
  const show = () => {
    const opens = (Date.parse(element.dataset.opens) - Date.now()) / 1000;
    const closes = (Date.parse(element.dataset.closes) - Date.now()) / 1000;
    if (opens > 0) element.textContent = `Opens in ${lasting(opens)}.`;
    else if (closes > 0) element.textContent = `Open. Closes in ${lasting(closes)}.`;
    else element.textContent = "Closed.";
    element.hidden = false;
  };
  show();
  setInterval(show, 30000);
}
