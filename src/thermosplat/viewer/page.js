// What the page does beyond viser's: the value under the cursor, the wipe's handle, the legend, and the key that lays
// the photograph over the render. All drawing and reading is the server's; #thermosplat-state holds what it last said.
(() => {
  "use strict";
  // viser draws fewer pixels while a browser is slow. Pictures have the window's pixels, and are drawn pixel by pixel.
  const words = new URLSearchParams(location.search);
  if (!words.has("fixedDpr")) {
    words.set("fixedDpr", String(window.devicePixelRatio || 1));
    history.replaceState(null, "", `?${words}`);
  }
  const style = document.createElement("style");
  // A list that opens over the edge of a phone's screen must not make the page larger: the panel, and the list with it,
  // would move away with every new size. And a list is no higher than the room above a panel.
  style.textContent = `
    html, body { overflow: clip; }
    body { position: fixed; inset: 0; }
    .mantine-Select-dropdown .mantine-ScrollArea-viewport, .mantine-Select-dropdown .mantine-ScrollArea-root {
      max-height: min(400px, 40vh) !important; }
    #ts-value { position: fixed; pointer-events: none; z-index: 5; padding: 3px 8px; border-radius: 6px; display: none;
      font: 600 13px/1.35 system-ui, sans-serif; color: #fff; background: rgba(16,18,24,.82); white-space: nowrap;
      box-shadow: 0 1px 6px rgba(0,0,0,.35); font-variant-numeric: tabular-nums; }
    #ts-legend { position: fixed; z-index: 4; pointer-events: none; color: #fff; font: 12px/1.3 system-ui, sans-serif;
      padding: 8px 12px; border-radius: 6px; background: rgba(16,18,24,.7); font-variant-numeric: tabular-nums; }
    #ts-legend:empty { display: none; }
    #ts-wipe { position: fixed; z-index: 4; width: 28px; margin-left: -14px; cursor: ew-resize; display: none;
      touch-action: none; }
    #ts-wipe::before { content: ""; position: absolute; left: 13px; top: 0; bottom: 0; width: 2px;
      background: rgba(255,255,255,.9); box-shadow: 0 0 4px rgba(0,0,0,.7); }
    #ts-wipe::after { content: "\\2194"; position: absolute; top: 50%; left: 1px; width: 26px; height: 26px;
      margin-top: -13px; border-radius: 50%; background: #fff; color: #222; text-align: center;
      font: 700 16px/25px system-ui, sans-serif; box-shadow: 0 1px 5px rgba(0,0,0,.5); }`;
  const make = (id) => Object.assign(document.createElement("div"), { id });
  const value = make("ts-value"), legend = make("ts-legend"), wipe = make("ts-wipe");
  document.addEventListener("DOMContentLoaded", () => {
    document.head.append(style);
    document.body.append(legend, wipe, value);
    setInterval(update, 100);
  });

  const state = () => document.getElementById("thermosplat-state");
  const canvas = () =>
    [...document.querySelectorAll("canvas")].sort((a, b) => b.clientWidth - a.clientWidth)[0];
  const ask = async (name, words) => {
    if (!state()) return null;
    const query = new URLSearchParams({ key: state().dataset.key, ...words });
    try {
      const reply = await fetch(`view/${name}?${query}`);
      return reply.ok ? await reply.json() : null;
    } catch {
      return null;
    }
  };

  // ---- the value under the cursor: one question at a time, the newest place next
  let place = null, asking = false;
  const probe = async () => {
    if (asking || !place) return;
    asking = true;
    while (place) {
      const at = place;
      place = null;
      const said = await ask("probe", { x: at.x, y: at.y });
      value.style.display = said && said.text && !hidden ? "block" : "none";
      if (said && said.text) value.textContent = said.text;
    }
    asking = false;
  };
  let hidden = true;
  let last = null;
  window.addEventListener("pointermove", (event) => {
    const box = canvas()?.getBoundingClientRect();
    hidden = !box || event.target.closest?.("#ts-wipe") || !isPicture(event.target);
    if (hidden) { value.style.display = "none"; last = null; return; }
    const flip = event.clientX > window.innerWidth - 160;
    value.style.left = flip ? "auto" : `${event.clientX + 16}px`;
    value.style.right = flip ? `${window.innerWidth - event.clientX + 12}px` : "auto";
    value.style.top = `${event.clientY + 14}px`;
    last = place = { x: (event.clientX - box.left) / box.width, y: (event.clientY - box.top) / box.height };
    probe();
  }, true);
  const isPicture = (target) => target.tagName === "CANVAS" && target.clientWidth > 300;
  document.addEventListener("pointerleave", () => { hidden = true; last = null; value.style.display = "none"; });

  // ---- the wipe's handle
  let dragging = false, sending = false, share = null;
  const send = async () => {
    if (sending) return;
    sending = true;
    while (share !== null) {
      const now = share;
      share = null;
      await ask("wipe", { share: now });
    }
    sending = false;
  };
  wipe.addEventListener("pointerdown", (event) => {
    dragging = true;
    wipe.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  wipe.addEventListener("pointermove", (event) => {
    if (!dragging) return;
    const box = canvas().getBoundingClientRect();
    share = Math.min(1, Math.max(0, (event.clientX - box.left) / box.width));
    wipe.style.left = `${box.left + share * box.width}px`;
    send();
  });
  wipe.addEventListener("pointerup", () => { dragging = false; });

  // ---- hold P: the photograph over the render
  let over = false;
  const lay = (on) => { if (over !== on) { over = on; ask("over", { on: on ? 1 : 0 }); } };
  const writes = (target) => target.closest?.("input, textarea, [contenteditable]");
  window.addEventListener("keydown", (event) => {
    if (event.key.toLowerCase() === "p" && !event.ctrlKey && !event.metaKey && !writes(event.target)) lay(true);
  });
  window.addEventListener("keyup", (event) => { if (event.key.toLowerCase() === "p") lay(false); });
  window.addEventListener("blur", () => lay(false));

  // ---- what the server last said
  let version = null;
  function update() {
    const said = state(), box = canvas()?.getBoundingClientRect();
    if (!said || !box) { legend.innerHTML = ""; wipe.style.display = "none"; return; }
    legend.style.left = `${box.left + 12}px`;
    legend.style.bottom = `${window.innerHeight - box.bottom + 14}px`;
    if (said.dataset.version !== version) {
      version = said.dataset.version;
      legend.innerHTML = said.innerHTML;
      if (last && !hidden) { place = last; probe(); } // the picture under a resting cursor has changed
    }
    const at = said.dataset.wipe;
    wipe.style.display = at === "" ? "none" : "block";
    wipe.style.top = `${box.top}px`;
    wipe.style.height = `${box.height}px`;
    if (!dragging && at !== "") wipe.style.left = `${box.left + Number(at) * box.width}px`;
  }
})();
