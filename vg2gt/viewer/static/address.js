// What the page's address asks for after its #, as in #camera=INDEX&show=cameras,images&fly=on&ui=off.

const ON_OR_OFF = ["on", "off"];

// Returns the wished camera (null: none), boxes and panel, and a text on what cannot be had (empty: nothing).
function readAddress(hash, cameras) {
  const wanted = { camera: null, boxes: { cameras: false, images: false, fly: false }, panel: true }, refused = [];
  for (const [key, value] of new URLSearchParams(hash.replace(/^#/, ""))) {
    const names = value.split(",").filter(Boolean);
    if (key === "camera" && /^\d+$/.test(value) && Number(value) < cameras) {
      wanted.camera = Number(value);
    } else if (key === "show" && names.every((name) => name === "cameras" || name === "images")) {
      for (const name of names) wanted.boxes[name] = true;
    } else if (key === "fly" && ON_OR_OFF.includes(value)) {
      wanted.boxes.fly = value === "on";
    } else if (key === "ui" && ON_OR_OFF.includes(value)) {
      wanted.panel = value === "on";
    } else {
      refused.push(`${key}=${value}`);
    }
  }
  const known = `camera=0 to camera=${cameras - 1}, show=cameras,images, fly=on and ui=off`;
  const problem = refused.length ? `The page's address has ${refused.join(" and ")}; it takes ${known}.` : "";
  return { ...wanted, problem };
}
