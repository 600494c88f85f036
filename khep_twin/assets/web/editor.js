// Input to the drawing by mouse, finger, pen and keys.
//
// A gesture starts with a pressed pointer and ends with its release. Its kinds: "move" parts, "turn" or "size" one part,
// move a corner ("point0"), "marquee" (select in a rectangle), "pan" or "pinch" the view; during a run, "lift" a robot,
// and "twist" it by two fingers.

import { createSvg } from "./drawing.js";
import { clampFinite, readUndoKey, rotate, roundHundredths, shift, wrapAngle } from "./model.js";

// Handles differ in shape: a round arrow turns, a square changes the size, a disc moves a corner.
const HANDLES = {
  turn: { title: "Drag to turn", draw: () => [createSvg("circle", { r: 10 }), createSvg("path", { d: "M4.5 -2.6A5.2 5.2 0 1 0 5 1.5M5.6 -6.4V-2H1.2", class: "arrow" })] },
  size: { title: "Drag to change the size", draw: () => [createSvg("rect", { x: -6, y: -6, width: 12, height: 12 })] },
  point: { title: "Drag to move this corner", draw: () => [createSvg("circle", { r: 7 })] },
};

const toDegrees = (x, y) => (Math.atan2(y, x) * 180) / Math.PI;

export class Editor {
  tool = "select";
  isLocked = false; // the tool stays selected for several objects
  #gesture = null;
  #wallPoints = null;
  #fingers = new Map(); // positions in the window by pointer
  #lastMove = null;
  #frame = 0;

  constructor(drawing, model, { readSnap, onTool, running }) {
    Object.assign(this, { drawing, model, readSnap, onTool, running });
    const { svg } = drawing;
    drawing.onView = () => this.drawHandles();
    svg.addEventListener("pointerdown", (event) => this.#onDown(event));
    svg.addEventListener("pointermove", (event) => this.#onMove(event));
    svg.addEventListener("pointerup", (event) => this.#onUp(event));
    svg.addEventListener("pointercancel", (event) => this.#onUp(event));
    svg.addEventListener("dblclick", () => this.endWall());
    svg.addEventListener("contextmenu", (event) => event.preventDefault());
    svg.addEventListener("wheel", (event) => this.#onWheel(event), { passive: false });
    svg.addEventListener("focusin", (event) => {
      const id = event.target.closest?.(".drawn")?.dataset.id;
      if (id && !this.#gesture && !model.selected.has(id) && event.target.matches(":focus-visible")) model.select([id]);
    });
    model.addEventListener("change", ({ detail }) => {
      if (detail === "draft") {
        drawing.drawAll();
        // The dragged part may be missing or another one: a key may have removed it or undone a step.
        if (!["lift", "twist"].includes(this.#gesture?.kind)) this.#gesture = null;
      } else drawing.markParts();
      this.drawHandles();
    });
    model.addEventListener("moved", ({ detail }) => {
      drawing.updateParts(detail);
      this.drawHandles();
    });
  }

  // Selects a tool: a locked one for several objects, another for one.
  selectTool(tool, isLocked = false) {
    this.endWall();
    Object.assign(this, { tool, isLocked });
    this.drawing.svg.classList.toggle("draw", tool !== "select");
    this.onTool(tool);
  }

  // Selects a tool; if it is selected already, toggles its lock.
  toggleTool(tool) {
    this.selectTool(tool, tool !== "select" && tool === this.tool && !this.isLocked);
  }

  // Adds the wall whose corners were clicked.
  endWall() {
    const points = this.#wallPoints;
    this.#wallPoints = null;
    if (!points) return;
    this.drawing.overlay.replaceChildren();
    if (points.length > 1) this.model.add("wall", { points_mm: points });
    this.#leaveTool();
  }

  // Draws the handles of a single selected part.
  drawHandles() {
    const { drawing, model } = this;
    const { overlay } = drawing;
    if (this.#wallPoints) return;
    overlay.replaceChildren();
    if (this.running.isActive || model.selected.size !== 1 || !drawing.svg.isConnected) return;
    const [id] = model.selected;
    const part = model.part(id);
    if (!part) return;
    const { pixelMm } = drawing;
    const handle = (kind, x, y) => {
      const parts = HANDLES[kind] ?? HANDLES.point;
      const title = createSvg("title");
      title.textContent = parts.title;
      return createSvg("g", { class: `handle ${kind}`, "data-handle": kind, transform: `translate(${x} ${y}) scale(${pixelMm} ${-pixelMm})` }, title, ...parts.draw());
    };
    if (part.points_mm) {
      overlay.append(...part.points_mm.map(([x, y], index) => handle(`point${index}`, x, y)));
      return;
    }
    const [x, y, length, width, radius] = ["x_mm", "y_mm", "length_mm", "width_mm", "radius_mm"].map((key) => clampFinite(part[key]));
    const rotation = (clampFinite(part.heading_deg ?? part.angle_deg) * Math.PI) / 180;
    const toArena = (along, across) => [x + along * Math.cos(rotation) - across * Math.sin(rotation), y + along * Math.sin(rotation) + across * Math.cos(rotation)];
    if (part.length_mm !== undefined || "heading_deg" in part) {
      const distance = (length / 2 || drawing.shapes[part.model]?.radius_mm || 28) + 24 * pixelMm;
      const [hx, hy] = toArena(distance, 0);
      overlay.append(createSvg("path", { d: `M${x} ${y}L${hx} ${hy}`, class: "marquee" }), handle("turn", hx, hy));
    }
    if (part.length_mm !== undefined) overlay.append(handle("size", ...toArena(length / 2, width / 2)));
    else if (part.radius_mm !== undefined) overlay.append(handle("size", x + radius, y));
  }

  handleKey(event) {
    const { model, drawing } = this;
    const command = event.ctrlKey || event.metaKey;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (command) {
      const isUndo = readUndoKey(event);
      const actions = { d: () => model.copy(), a: () => model.select(model.ids()) };
      if (isUndo !== null) isUndo ? model.undo() : model.redo();
      else if (this.running.isActive || !actions[key]) return false;
      else actions[key]();
      return true;
    }
    if (["+", "=", "-", "0"].includes(key)) {
      if (key === "0") drawing.fit();
      else drawing.zoom(key === "-" ? 1.25 : 0.8);
      return true;
    }
    const pan = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[key];
    if (pan && !model.selected.size && drawing.svg.contains(document.activeElement)) {
      const { x, y, width, height } = drawing.view;
      drawing.setView(x + pan[0] * width, y + pan[1] * height, width, height);
      return true;
    }
    if (this.running.isActive) return false;
    const tools = { v: "select", b: "block", c: "cylinder", w: "wall", l: "lamp", r: "robot", p: "patch", s: "spot" };
    if (tools[key]) {
      if (!event.repeat) this.toggleTool(tools[key]);
      return true;
    }
    if (key === "Escape") {
      this.#wallPoints = null;
      this.selectTool("select");
      model.select([]);
      return true;
    }
    if (key === "Enter") {
      if (this.#wallPoints) return this.endWall(), true;
      if (this.tool === "select") return false;
      const { x, y, width, height } = drawing.view;
      const [x_mm, y_mm] = this.#clampToArena([x + width / 2, -(y + height / 2)]);
      const position = this.tool === "wall" ? { points_mm: [this.#clampToArena([x_mm - 50, y_mm]), this.#clampToArena([x_mm + 50, y_mm])] } : { x_mm, y_mm };
      model.add(this.tool, position);
      this.#leaveTool();
      return true;
    }
    if (!model.selected.size) return false;
    const step = event.altKey ? 1 : (this.readSnap().grid || 1) * (event.shiftKey ? 10 : 1);
    const shifts = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
    const rotations = { "[": 1, "]": -1 };
    if (key === "Delete" || key === "Backspace") model.remove();
    else if (shifts[key] || rotations[key]) {
      for (const id of model.selected) {
        if (shifts[key]) shift(model.part(id), ...shifts[key]);
        else rotate(model.part(id), rotations[key] * (event.altKey ? 1 : this.readSnap().angle || 1));
      }
      model.commit();
    } else return false;
    return true;
  }

  #leaveTool() {
    if (!this.isLocked) this.selectTool("select");
  }

  // Rounds a coordinate to the grid, or with `isFree` to 0.01 mm.
  #snapToGrid(value, isFree = false) {
    const step = this.readSnap().grid;
    return step > 0 && !isFree ? roundHundredths(Math.round(value / step) * step) : roundHundredths(value);
  }

  #snapAngle(value, isFree = false) {
    const step = this.readSnap().angle;
    return wrapAngle(step > 0 && !isFree ? Math.round(value / step) * step : Math.round(value * 10) / 10);
  }

  #clampToArena([x, y], isFree) {
    const { width_mm, height_mm } = this.model.draft.arena;
    return [Math.min(Math.max(this.#snapToGrid(x, isFree), 0), width_mm), Math.min(Math.max(this.#snapToGrid(y, isFree), 0), height_mm)];
  }

  #onDown(event) {
    const { drawing, model } = this;
    const position = drawing.pointerPosition(event);
    if (event.pointerType === "touch") {
      this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
      drawing.svg.setPointerCapture(event.pointerId);
      if (this.#fingers.size > 1) return void this.#startPinch();
    }
    const target = event.target.closest?.("[data-handle], .drawn, .live");
    if (this.running.isActive && this.running.handling.pointerDown(event, position, target)) {
      this.#gesture = { kind: "lift", pointerId: event.pointerId };
      drawing.svg.setPointerCapture(event.pointerId);
      return;
    }
    if (event.button === 1 || this.running.isActive || (event.button === 0 && event.ctrlKey && !target)) {
      this.#gesture = { kind: "pan", start: [event.clientX, event.clientY], view: { ...drawing.view } };
    } else if (event.button === 2) {
      // The right button removes a part, as in the toolbox's designer.
      if (target?.dataset.id) {
        model.select([target.dataset.id]);
        model.remove();
      }
      return;
    } else if (target?.dataset.handle) {
      this.#gesture = { kind: target.dataset.handle, id: [...model.selected][0] };
    } else if (this.tool === "wall") {
      this.#addCorner(this.#clampToArena(position, event.altKey));
      return;
    } else if (this.tool !== "select") {
      const [x_mm, y_mm] = this.#clampToArena(position, event.altKey);
      model.add(this.tool, { x_mm, y_mm });
      this.#startMove([...model.selected], position, [x_mm, y_mm], true);
    } else if (target?.dataset.id) {
      const { id } = target.dataset;
      if (event.shiftKey) model.select(model.selected.has(id) ? [...model.selected].filter((other) => other !== id) : [...model.selected, id]);
      else if (!model.selected.has(id)) model.select([id]);
      if (!model.selected.has(id)) return;
      const part = model.part(id);
      this.#startMove([...model.selected], position, part.points_mm ? [...part.points_mm[0]] : [part.x_mm, part.y_mm]);
    } else {
      if (!event.shiftKey) model.select([]);
      this.#gesture = { kind: "marquee", start: position, selected: [...model.selected] };
    }
    drawing.svg.setPointerCapture(event.pointerId);
    drawing.svg.focus({ preventScroll: true });
    event.preventDefault();
  }

  // Starts to move parts; `anchor` is the point that is snapped to the grid.
  #startMove(ids, start, anchor, isNew = false) {
    const originals = new Map(ids.map((id) => [id, structuredClone(this.model.part(id))]));
    this.#gesture = { kind: "move", ids, start, anchor, originals, isNew };
  }

  // Two fingers zoom and move the view, or turn a robot that one of them has lifted.
  #startPinch() {
    const gesture = this.#gesture;
    if (gesture?.kind === "lift" || gesture?.kind === "twist") {
      this.#gesture = { kind: "twist", pointerId: gesture.pointerId, rotation: this.#measureFingers().rotation };
      return;
    }
    if (gesture?.isNew) this.model.undo();
    else if (gesture && !["pan", "marquee", "pinch"].includes(gesture.kind)) this.model.commit();
    if (!gesture && this.#wallPoints?.pop() && !this.#wallPoints.length) this.#wallPoints = null;
    this.#gesture = { kind: "pinch", view: { ...this.drawing.view }, pixelMm: this.drawing.pixelMm, start: this.#measureFingers() };
  }

  #measureFingers() {
    const [[x, y], [x2, y2]] = [...this.#fingers.values()];
    return { x: (x + x2) / 2, y: (y + y2) / 2, length: Math.max(Math.hypot(x2 - x, y2 - y), 1), rotation: toDegrees(x2 - x, y - y2) };
  }

  #pinch({ kind, view, pixelMm, start, rotation }) {
    const fingers = this.#measureFingers();
    if (kind === "twist") {
      this.running.handling.rotate(wrapAngle(fingers.rotation - rotation));
      this.#gesture.rotation = fingers.rotation;
      return;
    }
    const { left, top, width, height } = this.drawing.svg.getBoundingClientRect();
    // The position between the fingers stays between them.
    const factor = Math.min(Math.max((view.width * start.length) / fingers.length, 40), 30000) / view.width;
    const [cx, cy] = [view.x + view.width / 2 + (start.x - left - width / 2) * pixelMm, view.y + view.height / 2 + (start.y - top - height / 2) * pixelMm];
    const [dx, dy] = [(fingers.x - left - width / 2) * pixelMm * factor, (fingers.y - top - height / 2) * pixelMm * factor];
    const [newWidth, newHeight] = [view.width * factor, view.height * factor];
    this.drawing.setView(cx - dx - newWidth / 2, cy - dy - newHeight / 2, newWidth, newHeight);
  }

  #onMove(event) {
    const position = this.drawing.pointerPosition(event);
    if (this.#fingers.has(event.pointerId)) this.#fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.#fingers.size > 1) {
      if (this.#gesture?.kind === "twist" && this.#gesture.pointerId === event.pointerId) this.running.handling.pointerMove(position);
      if (["pinch", "twist"].includes(this.#gesture?.kind)) this.#pinch(this.#gesture);
      return;
    }
    if (this.running.isActive && this.#gesture?.kind === "lift") return void this.running.handling.pointerMove(position);
    const gesture = this.#gesture;
    if (this.#wallPoints && !gesture) this.#drawUnfinishedWall(this.#clampToArena(position, event.altKey));
    this.onTool(this.tool, position);
    if (!gesture) return;
    // At most once per frame, however often the mouse moves.
    this.#lastMove = { position, event };
    if (this.#frame) return;
    this.#frame = requestAnimationFrame(() => {
      this.#frame = 0;
      if (this.#gesture) this.#drag(this.#gesture, this.#lastMove.position, this.#lastMove.event);
    });
  }

  #drag(gesture, position, event) {
    const { model, drawing } = this;
    const isFree = event.altKey;
    const part = gesture.id && model.part(gesture.id);
    if (gesture.kind === "pan") {
      const { x, y, width, height } = gesture.view;
      const { pixelMm } = drawing;
      drawing.setView(x - (event.clientX - gesture.start[0]) * pixelMm, y - (event.clientY - gesture.start[1]) * pixelMm, width, height);
    } else if (gesture.kind === "move") {
      const dx = this.#snapToGrid(gesture.anchor[0] + position[0] - gesture.start[0], isFree) - gesture.anchor[0];
      const dy = this.#snapToGrid(gesture.anchor[1] + position[1] - gesture.start[1], isFree) - gesture.anchor[1];
      for (const [id, original] of gesture.originals) {
        const copy = structuredClone(original);
        shift(copy, dx, dy);
        Object.assign(model.part(id), copy);
      }
      model.notifyMoved(gesture.ids);
    } else if (gesture.kind === "turn") {
      const key = "heading_deg" in part ? "heading_deg" : "angle_deg";
      part[key] = this.#snapAngle(toDegrees(position[0] - part.x_mm, position[1] - part.y_mm), isFree);
      model.notifyMoved([gesture.id]);
    } else if (gesture.kind === "size") {
      const [dx, dy] = [position[0] - part.x_mm, position[1] - part.y_mm];
      if (part.radius_mm !== undefined) part.radius_mm = Math.max(this.#snapToGrid(Math.hypot(dx, dy), isFree), 1);
      else {
        const rotation = ((part.angle_deg ?? 0) * Math.PI) / 180;
        part.length_mm = Math.max(this.#snapToGrid(2 * Math.abs(dx * Math.cos(rotation) + dy * Math.sin(rotation)), isFree), 1);
        part.width_mm = Math.max(this.#snapToGrid(2 * Math.abs(dy * Math.cos(rotation) - dx * Math.sin(rotation)), isFree), 1);
      }
      this.#redrawPart(gesture.id);
    } else if (gesture.kind.startsWith("point")) {
      part.points_mm[+gesture.kind.slice(5)] = this.#clampToArena(position, isFree);
      model.notifyMoved([gesture.id]);
    } else if (gesture.kind === "marquee") {
      const [x, y] = [Math.min(position[0], gesture.start[0]), Math.min(position[1], gesture.start[1])];
      const [width, height] = [Math.abs(position[0] - gesture.start[0]), Math.abs(position[1] - gesture.start[1])];
      const inside = (px, py) => px >= x && px <= x + width && py >= y && py <= y + height;
      const ids = model.ids().filter((id) => {
        const part = model.part(id);
        return part.points_mm ? part.points_mm.every((point) => inside(...point)) : inside(part.x_mm, part.y_mm);
      });
      model.select([...gesture.selected, ...ids]);
      drawing.overlay.append(createSvg("rect", { x, y, width, height, class: "marquee" }));
    }
  }

  #redrawPart(id) {
    const { drawing, model } = this;
    const node = drawing.createPart(id.split(":")[0], model.part(id));
    drawing.nodes.get(id).replaceChildren(...node.childNodes);
    model.notifyMoved([id]);
  }

  #onUp(event) {
    const gesture = this.#gesture;
    this.#fingers.delete(event.pointerId);
    if (gesture?.kind === "twist" && gesture.pointerId !== event.pointerId) {
      this.#gesture = { kind: "lift", pointerId: gesture.pointerId };
      return;
    }
    this.#gesture = null;
    if (["lift", "twist"].includes(gesture?.kind)) this.running.handling.pointerUp();
    else if (gesture && this.#frame) this.#drag(gesture, this.#lastMove.position, this.#lastMove.event);
    cancelAnimationFrame(this.#frame);
    this.#frame = 0;
    if (gesture && !["pan", "marquee", "lift", "twist", "pinch"].includes(gesture.kind)) this.model.commit();
    else this.drawHandles();
    if (gesture && this.tool !== "select" && gesture.kind === "move" && !event.shiftKey) this.#leaveTool();
  }

  #onWheel(event) {
    event.preventDefault();
    if (this.running.isActive && this.running.handling.rotate(event.deltaY > 0 ? -15 : 15)) return;
    this.drawing.zoom(1.0015 ** event.deltaY, this.drawing.pointerPosition(event));
  }

  #addCorner(point) {
    this.#wallPoints ??= [];
    const last = this.#wallPoints.at(-1);
    if (!last || last[0] !== point[0] || last[1] !== point[1]) this.#wallPoints.push(point);
    this.#drawUnfinishedWall(point);
  }

  #drawUnfinishedWall(point) {
    const path = [...this.#wallPoints, point].map((corner) => corner.join(" ")).join("L");
    this.drawing.overlay.replaceChildren(createSvg("path", { d: `M${path}`, class: "marquee", "stroke-width": 2 }));
  }
}
