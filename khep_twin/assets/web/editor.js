// Input to the drawing: mouse, finger, pen and keys.

import { make } from "./drawing.js";
import { angle, drawable, shift, tidy, turn, undoKey } from "./model.js";

// Distinguished by their shapes: an arrow around for turning, a square for the size, a disc for a corner.
const HANDLES = {
  turn: { title: "Drag to turn", draw: () => [make("circle", { r: 10 }), make("path", { d: "M4.5 -2.6A5.2 5.2 0 1 0 5 1.5M5.6 -6.4V-2H1.2", class: "arrow" })] },
  size: { title: "Drag to change the size", draw: () => [make("rect", { x: -6, y: -6, width: 12, height: 12 })] },
  point: { title: "Drag to move this corner", draw: () => [make("circle", { r: 7 })] },
};

const degrees = (x, y) => (Math.atan2(y, x) * 180) / Math.PI;

export class Editor {
  tool = "select";
  kept = false;
  #act = null;
  #wall = null;
  #fingers = new Map();

  constructor(drawing, model, { snap, told, running }) {
    Object.assign(this, { drawing, model, snap, told, running });
    const { svg } = drawing;
    drawing.handles = () => this.handles();
    svg.addEventListener("pointerdown", (event) => this.#down(event));
    svg.addEventListener("pointermove", (event) => this.#move(event));
    svg.addEventListener("pointerup", (event) => this.#up(event));
    svg.addEventListener("pointercancel", (event) => this.#up(event));
    svg.addEventListener("dblclick", () => this.endWall());
    svg.addEventListener("contextmenu", (event) => event.preventDefault());
    svg.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    svg.addEventListener("focusin", (event) => {
      const id = event.target.closest?.(".drawn")?.dataset.id;
      if (id && !this.#act && !model.selected.has(id) && event.target.matches(":focus-visible")) model.select([id]);
    });
    model.addEventListener("change", ({ detail }) => {
      if (detail === "whole") {
        drawing.all();
        // What is dragged may be gone, or another: a key can remove it or take a step back meanwhile.
        if (!["running", "twist"].includes(this.#act?.kind)) this.#act = null;
      } else drawing.marks();
      this.handles();
    });
    model.addEventListener("moved", ({ detail }) => {
      drawing.some(detail);
      this.handles();
    });
  }

  // A kept tool stays for several objects; another is left after the first one.
  use(tool, kept = false) {
    this.endWall();
    Object.assign(this, { tool, kept });
    this.drawing.svg.classList.toggle("draw", tool !== "select");
    this.told(tool);
  }

  // Selects a tool; if it is selected already, toggles whether it is kept.
  take(tool) {
    this.use(tool, tool !== "select" && tool === this.tool && !this.kept);
  }

  #placed() {
    if (!this.kept) this.use("select");
  }

  grid(value, free = false) {
    const step = this.snap().grid;
    return step > 0 && !free ? tidy(Math.round(value / step) * step) : tidy(value);
  }

  round(value, free = false) {
    const step = this.snap().angle;
    return angle(step > 0 && !free ? Math.round(value / step) * step : Math.round(value * 10) / 10);
  }

  #inside([x, y], free) {
    const { width_mm, height_mm } = this.model.draft.arena;
    return [Math.min(Math.max(this.grid(x, free), 0), width_mm), Math.min(Math.max(this.grid(y, free), 0), height_mm)];
  }

  #down(event) {
    const { drawing, model } = this;
    const at = drawing.point(event);
    if (event.pointerType === "touch") {
      this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
      drawing.svg.setPointerCapture(event.pointerId);
      if (this.#fingers.size > 1) return void this.#pinch();
    }
    const target = event.target.closest?.("[data-handle], .drawn, .live");
    if (this.running.active && this.running.handling.down(event, at, target)) {
      this.#act = { kind: "running", hand: event.pointerId };
      drawing.svg.setPointerCapture(event.pointerId);
      return;
    }
    if (event.button === 1 || this.running.active || (event.button === 0 && event.ctrlKey && !target)) {
      this.#act = { kind: "pan", at: [event.clientX, event.clientY], view: { ...drawing.view } };
    } else if (event.button === 2) {
      // As in the toolbox's designer: the right button removes.
      if (target?.dataset.id) {
        model.select([target.dataset.id]);
        model.remove();
      }
      return;
    } else if (target?.dataset.handle) {
      this.#act = { kind: target.dataset.handle, id: [...model.selected][0], at };
    } else if (this.tool === "wall") {
      this.#point(this.#inside(at, event.altKey));
      return;
    } else if (this.tool !== "select") {
      const [x_mm, y_mm] = this.#inside(at, event.altKey);
      model.add(this.tool, { x_mm, y_mm });
      this.#begin([...model.selected], at, [x_mm, y_mm], true);
    } else if (target?.dataset.id) {
      const { id } = target.dataset;
      if (event.shiftKey) model.select(model.selected.has(id) ? [...model.selected].filter((each) => each !== id) : [...model.selected, id]);
      else if (!model.selected.has(id)) model.select([id]);
      if (!model.selected.has(id)) return;
      const thing = model.at(id);
      this.#begin([...model.selected], at, thing.points_mm ? [...thing.points_mm[0]] : [thing.x_mm, thing.y_mm]);
    } else {
      if (!event.shiftKey) model.select([]);
      this.#act = { kind: "marquee", at, before: [...model.selected] };
    }
    drawing.svg.setPointerCapture(event.pointerId);
    drawing.svg.focus({ preventScroll: true });
    event.preventDefault();
  }

  #begin(ids, at, anchor, fresh = false) {
    const from = new Map(ids.map((id) => [id, structuredClone(this.model.at(id))]));
    this.#act = { kind: "move", ids, at, anchor, from, fresh };
  }

  // Two fingers zoom and move the view, and turn a robot that one of them has lifted.
  #pinch() {
    const act = this.#act;
    if (act?.kind === "running" || act?.kind === "twist") {
      this.#act = { kind: "twist", hand: act.hand, from: this.#span().angle };
      return;
    }
    if (act?.fresh) this.model.undo();
    else if (act && !["pan", "marquee", "pinch"].includes(act.kind)) this.model.commit();
    if (!act && this.#wall?.pop() && !this.#wall.length) this.#wall = null;
    this.#act = { kind: "pinch", view: { ...this.drawing.view }, pixel: this.drawing.pixel, from: this.#span() };
  }

  #span() {
    const [[x, y], [x2, y2]] = [...this.#fingers.values()];
    return { x: (x + x2) / 2, y: (y + y2) / 2, length: Math.max(Math.hypot(x2 - x, y2 - y), 1), angle: degrees(x2 - x, y - y2) };
  }

  #spread({ kind, view, pixel, from }) {
    const now = this.#span();
    if (kind === "twist") {
      this.running.handling.turn(angle(now.angle - from));
      this.#act.from = now.angle;
      return;
    }
    const { left, top, width, height } = this.drawing.svg.getBoundingClientRect();
    // The position between the fingers stays there.
    const factor = Math.min(Math.max((view.width * from.length) / now.length, 40), 30000) / view.width;
    const [cx, cy] = [view.x + view.width / 2 + (from.x - left - width / 2) * pixel, view.y + view.height / 2 + (from.y - top - height / 2) * pixel];
    const [dx, dy] = [(now.x - left - width / 2) * pixel * factor, (now.y - top - height / 2) * pixel * factor];
    const [wide, high] = [view.width * factor, view.height * factor];
    this.drawing.look(cx - dx - wide / 2, cy - dy - high / 2, wide, high);
  }

  #move(event) {
    const at = this.drawing.point(event);
    if (this.#fingers.has(event.pointerId)) this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.#fingers.size > 1) {
      if (this.#act?.kind === "twist" && this.#act.hand === event.pointerId) this.running.handling.move(event, at);
      if (["pinch", "twist"].includes(this.#act?.kind)) this.#spread(this.#act);
      return;
    }
    if (this.running.active && this.#act?.kind === "running") return void this.running.handling.move(event, at);
    const act = this.#act;
    if (this.#wall && !act) this.#sketch(this.#inside(at, event.altKey));
    this.told(this.tool, at);
    if (!act) return;
    // At most once per frame, however often the mouse moves.
    this.last = { at, event };
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      if (this.#act) this.#drag(this.#act, this.last.at, this.last.event);
    });
  }

  #drag(act, at, event) {
    const { model, drawing } = this;
    const free = event.altKey;
    const thing = act.id && model.at(act.id);
    if (act.kind === "pan") {
      const { x, y, width, height } = act.view;
      const pixel = drawing.pixel;
      drawing.look(x - (event.clientX - act.at[0]) * pixel, y - (event.clientY - act.at[1]) * pixel, width, height);
    } else if (act.kind === "move") {
      const dx = this.grid(act.anchor[0] + at[0] - act.at[0], free) - act.anchor[0];
      const dy = this.grid(act.anchor[1] + at[1] - act.at[1], free) - act.anchor[1];
      for (const [id, before] of act.from) {
        const copy = structuredClone(before);
        shift(copy, dx, dy);
        Object.assign(model.at(id), copy);
      }
      model.moved(act.ids);
    } else if (act.kind === "turn") {
      const key = "heading_deg" in thing ? "heading_deg" : "angle_deg";
      thing[key] = this.round(degrees(at[0] - thing.x_mm, at[1] - thing.y_mm), free);
      model.moved([act.id]);
    } else if (act.kind === "size") {
      const [dx, dy] = [at[0] - thing.x_mm, at[1] - thing.y_mm];
      if (thing.radius_mm !== undefined) thing.radius_mm = Math.max(this.grid(Math.hypot(dx, dy), free), 1);
      else {
        const turned = ((thing.angle_deg ?? 0) * Math.PI) / 180;
        thing.length_mm = Math.max(this.grid(2 * Math.abs(dx * Math.cos(turned) + dy * Math.sin(turned)), free), 1);
        thing.width_mm = Math.max(this.grid(2 * Math.abs(dy * Math.cos(turned) - dx * Math.sin(turned)), free), 1);
      }
      this.#again(act.id);
    } else if (act.kind.startsWith("point")) {
      thing.points_mm[+act.kind.slice(5)] = this.#inside(at, free);
      model.moved([act.id]);
    } else if (act.kind === "marquee") {
      const [x, y] = [Math.min(at[0], act.at[0]), Math.min(at[1], act.at[1])];
      const [width, height] = [Math.abs(at[0] - act.at[0]), Math.abs(at[1] - act.at[1])];
      const inside = (px, py) => px >= x && px <= x + width && py >= y && py <= y + height;
      const met = model.ids().filter((id) => {
        const each = model.at(id);
        return each.points_mm ? each.points_mm.every((point) => inside(...point)) : inside(each.x_mm, each.y_mm);
      });
      model.select([...act.before, ...met]);
      drawing.over.append(make("rect", { x, y, width, height, class: "marquee" }));
    }
  }

  #again(id) {
    const { drawing, model } = this;
    const fresh = drawing.shape(id.split(":")[0], model.at(id));
    drawing.nodes.get(id).replaceChildren(...fresh.childNodes);
    model.moved([id]);
  }

  #up(event) {
    const act = this.#act;
    this.#fingers.delete(event.pointerId);
    if (act?.kind === "twist" && act.hand !== event.pointerId) {
      this.#act = { kind: "running", hand: act.hand };
      return;
    }
    this.#act = null;
    if (["running", "twist"].includes(act?.kind)) this.running.handling.up(event, this.drawing.point(event));
    else if (act && this.pending) this.#drag(act, this.last.at, this.last.event);
    cancelAnimationFrame(this.pending);
    this.pending = 0;
    if (act && !["pan", "marquee", "running", "twist", "pinch"].includes(act.kind)) this.model.commit();
    else this.handles();
    if (act && this.tool !== "select" && act.kind === "move" && !event.shiftKey) this.#placed();
  }

  #wheel(event) {
    event.preventDefault();
    if (this.running.active && this.running.handling.turn(event.deltaY > 0 ? -15 : 15)) return;
    this.drawing.zoom(1.0015 ** event.deltaY, this.drawing.point(event));
  }

  #point(point) {
    this.#wall ??= [];
    const last = this.#wall.at(-1);
    if (!last || last[0] !== point[0] || last[1] !== point[1]) this.#wall.push(point);
    this.#sketch(point);
  }

  #sketch(point) {
    const path = [...this.#wall, point].map((each) => each.join(" ")).join("L");
    this.drawing.over.replaceChildren(make("path", { d: `M${path}`, class: "marquee", "stroke-width": 2 }));
  }

  endWall() {
    const points = this.#wall;
    this.#wall = null;
    if (!points) return;
    this.drawing.over.replaceChildren();
    if (points.length > 1) this.model.add("wall", { points_mm: points });
    this.#placed();
  }

  // Handles to turn and size a single selected thing.
  handles() {
    const { drawing, model } = this;
    const { over } = drawing;
    if (this.#wall) return;
    over.replaceChildren();
    if (this.running.active || model.selected.size !== 1 || !drawing.svg.isConnected) return;
    const [id] = model.selected;
    const thing = model.at(id);
    if (!thing) return;
    const pixel = drawing.pixel;
    const handle = (kind, x, y) => {
      const parts = HANDLES[kind] ?? HANDLES.point;
      const told = make("title");
      told.textContent = parts.title;
      return make("g", { class: `handle ${kind}`, "data-handle": kind, transform: `translate(${x} ${y}) scale(${pixel} ${-pixel})` }, told, ...parts.draw());
    };
    if (thing.points_mm) {
      over.append(...thing.points_mm.map(([x, y], index) => handle(`point${index}`, x, y)));
      return;
    }
    const [x, y, length, width, radius] = ["x_mm", "y_mm", "length_mm", "width_mm", "radius_mm"].map((key) => drawable(thing[key]));
    const turned = (drawable(thing.heading_deg ?? thing.angle_deg) * Math.PI) / 180;
    const at = (along, across) => [x + along * Math.cos(turned) - across * Math.sin(turned), y + along * Math.sin(turned) + across * Math.cos(turned)];
    if (thing.length_mm !== undefined || "heading_deg" in thing) {
      const reach = (length || 56) / 2 + 24 * pixel;
      const [hx, hy] = at(reach, 0);
      over.append(make("path", { d: `M${x} ${y}L${hx} ${hy}`, class: "marquee" }), handle("turn", hx, hy));
    }
    if (thing.length_mm !== undefined) over.append(handle("size", ...at(length / 2, width / 2)));
    else if (thing.radius_mm !== undefined) over.append(handle("size", x + radius, y));
  }

  key(event) {
    const { model, drawing } = this;
    const command = event.ctrlKey || event.metaKey;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (command) {
      const back = undoKey(event);
      const acts = { d: () => model.copy(), a: () => model.select(model.ids()) };
      if (back !== null) back ? model.undo() : model.redo();
      else if (this.running.active || !acts[key]) return false;
      else acts[key]();
      return true;
    }
    if (["+", "=", "-", "0"].includes(key)) {
      if (key === "0") drawing.fit();
      else drawing.zoom(key === "-" ? 1.25 : 0.8);
      return true;
    }
    const seen = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[key];
    if (seen && !model.selected.size && drawing.svg.contains(document.activeElement)) {
      const { x, y, width, height } = drawing.view;
      drawing.look(x + seen[0] * width, y + seen[1] * height, width, height);
      return true;
    }
    if (this.running.active) return false;
    const tools = { v: "select", b: "block", c: "cylinder", w: "wall", l: "lamp", r: "robot", p: "patch", s: "spot" };
    if (tools[key]) {
      if (!event.repeat) this.take(tools[key]);
      return true;
    }
    if (key === "Escape") {
      this.#wall = null;
      this.use("select");
      model.select([]);
      return true;
    }
    if (key === "Enter") {
      if (this.#wall) return this.endWall(), true;
      if (this.tool === "select") return false;
      const { x, y, width, height } = drawing.view;
      const [x_mm, y_mm] = this.#inside([x + width / 2, -(y + height / 2)]);
      const place = this.tool === "wall" ? { points_mm: [this.#inside([x_mm - 50, y_mm]), this.#inside([x_mm + 50, y_mm])] } : { x_mm, y_mm };
      model.add(this.tool, place);
      this.#placed();
      return true;
    }
    if (!model.selected.size) return false;
    const step = event.altKey ? 1 : (this.snap().grid || 1) * (event.shiftKey ? 10 : 1);
    const ways = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    const turns = { "[": 1, "]": -1 };
    if (key === "Delete" || key === "Backspace") model.remove();
    else if (ways[key] || turns[key]) {
      for (const id of model.selected) {
        if (ways[key]) shift(model.at(id), ...ways[key]);
        else turn(model.at(id), turns[key] * (event.altKey ? 1 : this.snap().angle || 1));
      }
      model.commit();
    } else return false;
    return true;
  }
}
