// Mouse, touch and keyboard. Every function that changes the view calls changed().

const TURN = 0.005;  // radians a pixel
const KEY_TURN = 1.2, KEY_FLY = 0.7;  // radians, and shares of the distance to the point ahead, a second

class Controls {
  constructor(canvas, view, changed, actions) {
    Object.assign(this, { canvas, view, changed, actions, fly: false });
    this.pointers = new Map();
    this.keys = new Set();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, event);
    });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.approach(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.003));
    }, { passive: false });
    window.addEventListener("keydown", (event) => this.press(event));
    window.addEventListener("keyup", (event) => this.keys.delete(event.key.toLowerCase()));
    window.addEventListener("blur", () => this.keys.clear());
  }

  approach(factor) {
    this.view.approach(factor);
    this.changed();
  }

  // One scene unit at the point ahead, in CSS pixels.
  pixelsPerUnit() {
    return this.view.fitted(this.canvas.clientWidth, this.canvas.clientHeight).fx / this.view.pivot;
  }

  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY;
    const shift = (share) => {
      const scale = share / this.pixelsPerUnit();
      this.view.move(-dx * scale, -dy * scale, 0);
    };
    if (this.pointers.size === 2) {
      const other = [...this.pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
      const distance = (pointer) =>
        Math.max(10, Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY));
      this.view.approach(distance(before) / distance(event));
      shift(0.5);
    } else if (event.buttons & 6 || event.shiftKey) {
      shift(1);
    } else if (this.fly) {
      this.view.turn(dx * TURN, dy * TURN, true);
    } else {
      this.view.turn(-dx * TURN, -dy * TURN, false);
    }
    this.pointers.set(event.pointerId, event);
    this.changed();
  }

  press(event) {
    const key = event.key.toLowerCase();
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("select, summary")) return;
    if (key in this.actions) {
      this.actions[key]();
    } else if ("wasdqe+-".includes(key) || key.startsWith("arrow")) {
      event.preventDefault();
      if (!this.keys.size) {
        this.last = performance.now();
        requestAnimationFrame((now) => this.step(now));
      }
      this.keys.add(key);
    }
  }

  // Moves on while keys are held.
  step(now) {
    if (!this.keys.size) return;
    const seconds = Math.max(0, Math.min(0.1, (now - this.last) / 1000));
    this.last = now;
    const held = (plus, minus) => (this.keys.has(plus) - this.keys.has(minus)) * seconds;
    const path = KEY_FLY * this.view.pivot;
    this.view.move(path * held("d", "a"), path * held("e", "q"), path * held("w", "s"));
    this.view.approach(Math.exp(held("-", "+")));
    const sideways = KEY_TURN * held("arrowright", "arrowleft"), upwards = KEY_TURN * held("arrowup", "arrowdown");
    this.view.turn(this.fly ? -sideways : sideways, this.fly ? upwards : -upwards, this.fly);
    this.changed();
    requestAnimationFrame((later) => this.step(later));
  }
}
