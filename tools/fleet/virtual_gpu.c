// A Vulkan layer under which every adapter calls itself a virtual GPU: so check_fleet.py tries on a software
// driver what is meant for GPUs. What it needs of Vulkan's headers is written out: they are not where a
// compiler alone is installed.
#include <stdint.h>
#include <string.h>

typedef void (*Function)(void);
typedef Function (*GetProc)(void *instance, const char *name);
typedef int (*CreateInstance)(const void *info, const void *allocator, void **instance);
typedef void (*GetProperties)(void *adapter, void *properties);

// VkLayerInstanceLink and VkLayerInstanceCreateInfo: the loader's way to say who comes next.
struct Link {
  struct Link *next;
  GetProc get;
  Function get_physical;
};
struct Info {
  int type;
  const struct Info *next;
  int function;
  struct Link *link;
};

static GetProc below;
static GetProperties below_properties, below_properties2;

static int create(const void *info, const void *allocator, void **instance) {
  // 47: VK_STRUCTURE_TYPE_LOADER_INSTANCE_CREATE_INFO, 0: VK_LAYER_LINK_INFO;
  // -3: VK_ERROR_INITIALIZATION_FAILED
  const struct Info *chain = ((const struct Info *)info)->next;
  while (chain && !(chain->type == 47 && chain->function == 0)) chain = chain->next;
  if (!chain) return -3;
  below = chain->link->get;
  ((struct Info *)chain)->link = chain->link->next; // as every layer does: the next one reads from there
  int code = ((CreateInstance)below(0, "vkCreateInstance"))(info, allocator, instance);
  if (code) return code;
  // now, while the instance still leads down: later the same question is answered with what is below
  below_properties = (GetProperties)below(*instance, "vkGetPhysicalDeviceProperties");
  below_properties2 = (GetProperties)below(*instance, "vkGetPhysicalDeviceProperties2");
  return 0;
}

// VkPhysicalDeviceProperties begins with four numbers, the fifth is what kind it is: 3 is a virtual GPU.
static void properties(void *adapter, void *out) {
  below_properties(adapter, out);
  ((uint32_t *)out)[4] = 3;
}

// In VkPhysicalDeviceProperties2 a type and a pointer come first.
static void properties2(void *adapter, void *out) {
  below_properties2(adapter, out);
  ((uint32_t *)out)[4 + 4] = 3;
}

static Function get(void *instance, const char *name) {
  if (!strcmp(name, "vkGetInstanceProcAddr")) return (Function)get;
  if (!strcmp(name, "vkCreateInstance")) return (Function)create;
  if (!strcmp(name, "vkGetPhysicalDeviceProperties")) return (Function)properties;
  if (!strcmp(name, "vkGetPhysicalDeviceProperties2")) return (Function)properties2;
  if (!strcmp(name, "vkGetPhysicalDeviceProperties2KHR")) return (Function)properties2;
  return below ? below(instance, name) : 0;
}

// For the loader alone: from in here its own function of this name would be found.
Function vkGetInstanceProcAddr(void *instance, const char *name) { return get(instance, name); }
