// The player of a page: a clock that draws a moment, a bar to control it, cursors on the plots.
"use strict";
function rigidmdData(id) {
  return JSON.parse(document.getElementById(id).textContent);
}
function rigidmdArray(text, kind) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  return new kind(bytes.buffer);
}
// animation: {times, unit, begin, show(time) -> nothing or a promise}; begin: the time at which it starts
function rigidmdPlayer(film) {
  const find = (name) => document.getElementById("film-" + name);
  const first = film.times[0], last = film.times[film.times.length - 1], span = last - first || 1;
  const begin = Math.min(last, Math.max(first, film.begin ?? first));
  const slider = find("slider"), button = find("play"), speed = find("speed"), clock = find("clock");
  const digits = Math.max(0, Math.min(6, 3 - Math.floor(Math.log10(span))));
  let now = first, playing = false, before = 0, busy = false;
  const seconds = [1, 2, 5, 10, 20, 40, 80, 160, 320, 640];
  const words = (s) => {
    if (film.unit !== "s") return `${(span / s).toPrecision(2) * 1} ${film.unit} per second`;
    const rate = span / s;
    if (Math.abs(rate - 1) < 0.02) return "real time";
    return rate < 1 ? `${(1 / rate).toPrecision(2) * 1} times slower` : `${rate.toPrecision(2) * 1} times faster`;
  };
  const lengths = film.unit === "s" ? [...new Set([...seconds, span])].filter((s) => s >= 0.5).sort((a, b) => a - b) : seconds;
  for (const s of lengths) speed.add(new Option(words(s), s));
  const wanted = film.unit === "s" && span >= 5 && span <= 40 ? span : film.length || 20;
  speed.value = lengths.reduce((a, b) => (Math.abs(Math.log(b / wanted)) < Math.abs(Math.log(a / wanted)) ? b : a));
  const figures = [...document.querySelectorAll("figure[data-box]")];
  const cursors = figures.map((figure) => {
    const line = document.createElement("div");
    line.className = "cursor";
    figure.append(line);
    const place = figure.dataset, [left, right, top, bottom] = place.box.split(" ").map(Number), from = +place.from, to = +place.to;
    line.style.top = 100 * top + "%";
    line.style.height = 100 * (bottom - top) + "%";
    figure.addEventListener("click", (event) => {
      const box = figure.getBoundingClientRect(), x = (event.clientX - box.left) / box.width;
      set(from + ((x - left) / (right - left)) * (to - from));
    });
    return (time) => {
      line.hidden = time < from || time > to;
      line.style.left = 100 * (left + ((time - from) / (to - from)) * (right - left)) + "%";
    };
  });
  async function set(time) {
    now = Math.min(last, Math.max(first, time));
    slider.value = Math.round((1e5 * (now - first)) / span);
    clock.textContent = `${now.toFixed(digits)} ${film.unit}`;
    cursors.forEach((move) => move(now));
    if (busy) return;
    busy = true;
    const shown = now;
    try { await film.show(shown); } finally { busy = false; }
    if (shown !== now && !playing) set(now);
  }
  function tick(stamp) {
    if (!playing) return;
    const step = before ? Math.min(0.2, (stamp - before) / 1000) : 0;
    before = stamp;
    let next = now + (step * span) / +speed.value;
    if (next > last) next = begin + ((next - last) % (last - begin || 1));
    if (!busy) set(next); else now = next;
    requestAnimationFrame(tick);
  }
  function play(on) {
    playing = on;
    before = 0;
    button.textContent = on ? "❚❚" : "▶";
    button.setAttribute("aria-label", on ? "pause" : "play");
    if (on) requestAnimationFrame(tick);
  }
  button.onclick = () => play(!playing);
  slider.oninput = () => { play(false); set(first + (slider.value / 1e5) * span); };
  const step = (k) => {
    play(false);
    let at = film.times.findIndex((t) => t > now + 1e-9 * span);
    if (at < 0) at = film.times.length;
    const here = Math.abs(film.times[at - 1] - now) < 1e-9 * span;
    set(film.times[Math.min(film.times.length - 1, Math.max(0, k > 0 ? at : here ? at - 2 : at - 1))]);
  };
  find("back").onclick = () => step(-1);
  find("on").onclick = () => step(1);
  document.addEventListener("keydown", (event) => {
    if (/INPUT|SELECT|TEXTAREA/.test(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); play(!playing); }
    if (event.key === "ArrowLeft") step(-1);
    if (event.key === "ArrowRight") step(1);
  });
  window.rigidmd = { set, play, get time() { return now; }, get busy() { return busy; } };
  const asked = /[#&]t=([^&]+)/.exec(location.hash); // page.html#t=1.5 begins there
  return set(asked ? +asked[1] || first : begin);
}
